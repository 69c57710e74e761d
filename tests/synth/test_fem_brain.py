"""A user's surface: holes and duplicates, placing, meshing, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from synth import brain, job
from synth.errors import UserError
from synth.fem import mesh
from synth.fem.element import bary_slope

OPENING = job.Craniotomy(point=(31.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0))


@pytest.fixture
def egg(tmp_path: Path) -> Path:
    """An ellipsoid as users have it: every face with its own vertices, some twice, some missing."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.vertices *= (32.0, 26.0, 22.0)
    faces = np.concatenate([ball.faces[20:], ball.faces[40:60]])
    path = tmp_path / "egg.obj"
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in ball.vertices[faces].reshape(-1, 3)]
    lines += [f"f {i} {i + 1} {i + 2}" for i in range(1, 3 * len(faces), 3)]
    path.write_text("\n".join(lines))
    return path


def test_surface_is_merged_and_placed(egg: Path) -> None:
    surface = brain.load(egg, OPENING)
    assert len(surface.vertices) < 700
    assert surface.vertices[:, 2].max() == pytest.approx(0.0, abs=0.3)
    assert np.ptp(surface.vertices[:, 2]) == pytest.approx(64, rel=0.01)


def test_axes_are_a_rotation_with_z_outwards() -> None:
    for direction in [*np.eye(3).tolist(), [0.3, -0.5, 0.8]]:
        turn = brain.axes(np.array(direction))
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(turn) == pytest.approx(1)
        assert turn[2] @ direction == pytest.approx(np.linalg.norm(direction))


def test_open_surface_is_meshed_whole(egg: Path) -> None:
    anatomy = job.Anatomy(mesh=egg, craniotomy=OPENING)
    tets = mesh.from_brain(brain.load(egg, OPENING), anatomy, 800, 2)
    volume = bary_slope(tets.points[tets.cells[:, :4]])[1]
    assert volume.min() > 0
    # Corners lie on the surface, faces are chords of it: some volume is lost, none is gained.
    assert 0.9 < volume.sum() / (4 / 3 * np.pi * 32 * 26 * 22) < 1.0
    again = mesh.from_brain(brain.load(egg, OPENING), anatomy, 800, 2)
    assert np.array_equal(tets.points, again.points)
    assert np.array_equal(tets.cells, again.cells)
    assert not tets.fixed.any()
    assert tets.hold.sum() > 0


def test_no_volume_and_no_surface_at_the_craniotomy_are_refused(egg: Path, tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.stl"
    trimesh.creation.box((50, 50, 0)).export(sheet)
    with pytest.raises(UserError, match="no volume"):
        brain.load(sheet, OPENING)
    with pytest.raises(UserError, match="no surface within"):
        brain.load(egg, job.Craniotomy(point=(90.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0)))
    with pytest.raises(UserError, match="no file"):
        brain.load(tmp_path / "none.obj", OPENING)
    torn = tmp_path / "torn.ply"
    torn.write_text("ply\nformat ascii 1.0\nelement vertex 3\n")
    with pytest.raises(UserError, match=r"torn\.ply"):
        brain.load(torn, OPENING)
