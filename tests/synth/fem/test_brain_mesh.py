"""A user's surface: holes and duplicates, placement, meshing, and refused files."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from egg_brain import OPENING, soup, written

from synth.errors import UserError
from synth.fem.mesh.element import bary_slope
from synth.geometry import brain_surface
from synth.job import schema
from synth.sequence.fem_mechanics import build_volume
from synth.sequence.simulation import simulate


@pytest.mark.parametrize("suffix", ["obj", "vtk"])
def test_a_messy_surface_of_every_format_is_meshed_and_moved(suffix: str, tmp_path: Path) -> None:
    path = written(tmp_path / f"egg.{suffix}", soup())
    case = schema.Job(
        frames=5,
        anatomy=schema.AnatomySection(mesh=path, vertices=2500, craniotomy=OPENING),
        fem=schema.FemSection(tets=600, load=0.1, gestures=("pull",)),
    )
    scene = simulate(case)
    tets, motion = build_volume(scene), scene.motion
    volume = bary_slope(tets.points[tets.cells[:, :4]])[1]
    assert volume.min() > 0
    assert volume.sum() == pytest.approx(4 / 3 * np.pi * 32 * 26 * 22, rel=0.03)
    peak = int(np.linalg.norm(motion.force, axis=1).argmax())
    total = np.einsum("v,vd->d", scene.vertex_area, motion.traction[peak])
    np.testing.assert_allclose(total, motion.force[peak], rtol=1e-9)
    assert 0.1 < np.linalg.norm(motion.displacement[peak], axis=1).max() < 10
    assert motion.min_jacobian is not None
    assert motion.min_jacobian.min() > 0.2


def test_a_surface_that_is_not_closed_at_the_craniotomy_is_refused(tmp_path: Path) -> None:
    egg = written(tmp_path / "egg.obj", soup())
    sheet, torn, bad = tmp_path / "sheet.stl", tmp_path / "torn.ply", tmp_path / "bad.vtk"
    trimesh.creation.box((50, 50, 0)).export(sheet)
    torn.write_text("ply\nformat ascii 1.0\nelement vertex 3\n")
    bad.write_text("# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\nPOINTS 2 float\n0 0 0\n")
    outside = schema.CraniotomySection(point=(90.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0))
    for path, opening in ((sheet, OPENING), (torn, OPENING), (bad, OPENING), (egg, outside)):
        with pytest.raises(UserError):
            brain_surface.load_brain(path, opening)


def test_holes_are_filled_on_request_and_surfaces_still_open_refused(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=30.0)
    middle = ball.triangles_center
    cut = (middle[:, 0] > -20) & (np.linalg.norm(middle - [0.0, 0.0, 30.0], axis=1) > 5)
    holed = written(tmp_path / "holed.obj", ball.triangles[cut])
    assert not trimesh.Trimesh(*brain_surface.read_brain(holed), process=False).is_watertight
    closed = trimesh.Trimesh(*brain_surface.read_brain(holed, fill_holes=True), process=False)
    assert closed.is_watertight
    assert closed.is_winding_consistent
    # The ball without the cap that the flat fan cuts off, 10 mm high at most.
    cap = np.pi * 10**2 * (30 - 10 / 3)
    assert 4 / 3 * np.pi * 30**3 - 1.15 * cap < closed.volume < ball.volume
    fin = np.concatenate([ball.triangles, [[*ball.triangles[0, :2], (0.0, 0.0, 90.0)]]])
    with pytest.raises(UserError, match=r"anatomy\.fill_holes"):
        brain_surface.read_brain(written(tmp_path / "fin.stl", fin), fill_holes=True)
