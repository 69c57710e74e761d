"""Motion and load of another engine's nodes on a scene's vertices: exact where they must be."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from synth.arrays import Floats, Ints
from synth.fem.external.transfer import attach
from synth.geometry.triangles import Shape, grid_faces


def cap(nodes: int, side_mm: float = 40.0, radius_mm: float = 70.0) -> tuple[Floats, Ints]:
    """A part of a sphere as a grid of nodes."""
    axis = np.linspace(-side_mm / 2, side_mm / 2, nodes)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
    z = np.sqrt(radius_mm**2 - x**2 - y**2) - radius_mm
    return np.stack([x, y, z], axis=1), grid_faces(nodes, nodes).reshape(-1, 3).astype(np.int64)


FINE = Shape(*cap(60, 34.0))


def dent(points: Floats) -> Floats:
    """A press of 2 mm, 5 mm wide, with some motion across."""
    depth = np.exp(-np.square(points[:, :2] - [3, 2]).sum(axis=1) / 50)
    return depth[:, None] * np.stack(
        [points[:, 0] / 10, np.full(len(points), 0.2), np.full(len(points), -2)], 1
    )


def test_rigid_motion_is_exact() -> None:
    points, faces = cap(25)
    turn, shift = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix(), np.array([1.0, 2.0, 3.0])
    displacement = attach(points, faces, FINE).move(points @ turn.T + shift - points)
    np.testing.assert_allclose(displacement, FINE.vertices @ turn.T + shift - FINE.vertices, atol=1e-12)


def test_smooth_motion_converges_by_the_third_power() -> None:
    def error(nodes: int) -> float:
        points, faces = cap(nodes)
        return float(np.abs(attach(points, faces, FINE).move(dent(points)) - dent(FINE.vertices)).max())

    coarse_error, fine_error = error(21), error(41)
    assert fine_error < 1.5e-3
    assert coarse_error / fine_error > 6


@pytest.mark.parametrize("nodes", [25, 161])
def test_force_keeps_its_size_and_nearly_its_place(nodes: int) -> None:
    """Of nodes that are farther apart than the scene's vertices, and closer."""
    points, faces = cap(nodes)
    rng = np.random.default_rng(0)
    inside = np.hypot(*points[:, :2].T) < 8
    force = np.where(inside[:, None], rng.normal(size=points.shape), 0.0)
    transfer = attach(points, faces, FINE)
    vertex_force = transfer.bear(force)
    np.testing.assert_allclose(vertex_force.sum(axis=0), force.sum(axis=0), atol=1e-12)
    moment, true_moment = (
        np.cross(positions, f).sum(axis=0)
        for positions, f in ((FINE.vertices, vertex_force), (points, force))
    )
    assert np.abs(moment - true_moment).max() < 0.05 * np.linalg.norm(force, axis=1).sum()
    edge_load = np.where(np.abs(points[:, :1]) > 19.5, 1.0, 0.0)
    assert not transfer.bear(np.tile(edge_load, 3)).any()


def test_work_of_a_smooth_load_is_preserved() -> None:
    points, faces = cap(41)
    transfer = attach(points, faces, FINE)
    load = dent(points)
    work = float((transfer.bear(load) * transfer.move(dent(points))).sum())
    assert work == pytest.approx(float((load * dent(points)).sum()), rel=0.01)
