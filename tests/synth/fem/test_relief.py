"""The block's upper boundary on gyri and sulci: how close, and never at the elements' expense."""

import numpy as np
import pytest
from dome import ANATOMY

from synth.fem.mesh import tetrahedra
from synth.fem.mesh.element import jacobians, quality, shape
from synth.fem.mesh.mesh_relief import HeightMap
from synth.fem.mesh.tetrahedra import Tets

EXTENT, SIDE = 34.0, 171
FOCUS = ((1.0, 2.0, 4.0),)


def sulci(depth: float, spacing: float) -> HeightMap:
    """Parallel valleys across a dome."""
    x = np.linspace(-EXTENT / 2, EXTENT / 2, SIDE)
    xy = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    valley = 0.5 * depth * (1 - np.cos(2 * np.pi * xy[:, 0] / spacing))
    return HeightMap((tetrahedra.dome(xy, ANATOMY.dome_mm) - valley).reshape(SIDE, SIDE), EXTENT)


def measure_gap(tets: Tets, height: HeightMap) -> float:
    """Root mean square height between the mesh and the map under the contact, mm."""
    faces = tetrahedra.boundary(tets.cells)
    centres = tets.points[faces[:, :3]].mean(axis=1)
    close_faces = faces[np.hypot(centres[:, 0] - 1.0, centres[:, 1] - 2.0) < 4.0]
    bary = np.random.default_rng(0).dirichlet(np.ones(3), 40)
    points = np.einsum("qn,fnd->fqd", shape(bary), tets.points[close_faces]).reshape(-1, 3)
    map_height = height.blend_into(lambda xy: tetrahedra.dome(xy, ANATOMY.dome_mm))(points[:, :2])
    return float(np.sqrt(np.mean((points[:, 2] - map_height) ** 2)))


@pytest.mark.slow
def test_the_boundary_lies_on_the_relief() -> None:
    height = sulci(1.4, 10.0)
    assert measure_gap(tetrahedra.block(1600, FOCUS, height), height) < 0.02
    assert measure_gap(tetrahedra.block(1600, FOCUS), height) > 0.4


def test_steep_clefts_leave_the_elements_sound_and_are_followed_closer_by_finer_meshes() -> None:
    clefts = sulci(2.0, 3.0)  # walls of up to 64 degrees
    coarse, fine = (tetrahedra.block(n, FOCUS, clefts) for n in (1600, 5000))
    for tets in (coarse, fine):
        assert quality(tets.points[tets.cells[:, :4]]).min() > 0.2
        assert jacobians(tets.points, tets.cells).min() > 0.4
    assert measure_gap(fine, clefts) < 0.5 * measure_gap(coarse, clefts)


def test_a_wild_relief_leaves_the_elements_sound() -> None:
    rough_map = HeightMap(np.random.default_rng(0).normal(0, 30.0, (SIDE, SIDE)), EXTENT)
    plain_tets = tetrahedra.block(400, FOCUS)
    least_quality = quality(plain_tets.points[plain_tets.cells[:, :4]]).min()
    for tets in (tetrahedra.block(n, FOCUS, rough_map) for n in (400, 3000)):
        assert quality(tets.points[tets.cells[:, :4]]).min() >= min(0.2, least_quality) - 1e-9
        assert jacobians(tets.points, tets.cells).min() >= 0.4
