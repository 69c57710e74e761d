"""A user's surface: holes and duplicates, placing, meshing, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from egg_brain import OPENING, soup, written

from synth.errors import UserError
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.element import bary_slope
from synth.geometry import brain_surface, vtk
from synth.job import schema
from synth.sequence import pipeline, scenario


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "vtk"])
def test_a_messy_surface_of_every_format_is_meshed_and_moved(suffix: str, tmp_path: Path) -> None:
    path = written(tmp_path / f"egg.{suffix}", soup())
    case = schema.Job(
        frames=5,
        anatomy=schema.Anatomy(mesh=path, vertices=2500, craniotomy=OPENING),
        fem=schema.Fem(tets=600, load=0.1, gestures=("pull",)),
    )
    drawn = scenario.draw(case, 0)
    surface, tets = pipeline.build(case, drawn)
    volume = bary_slope(tets.points[tets.cells[:, :4]])[1]
    assert volume.min() > 0
    assert volume.sum() == pytest.approx(4 / 3 * np.pi * 32 * 26 * 22, rel=0.03)
    motion = pipeline.move(case, drawn, surface, tets)
    peak = int(np.linalg.norm(motion.force, axis=1).argmax())
    total = np.einsum("v,vd->d", motion.area, motion.traction[peak])
    np.testing.assert_allclose(total, motion.force[peak], rtol=1e-9)
    assert 0.1 < np.linalg.norm(motion.displacement[peak], axis=1).max() < 10
    assert motion.min_jacobian.min() > 0.2


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("version", ["3.0", "5.1"])
def test_vtk_in_text_and_binary_of_both_generations(binary: bool, version: str, tmp_path: Path) -> None:
    """A pyramid: four triangles over a square, which is cut in two."""
    points = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 3]], np.float32)
    cells = [[3, 2, 1, 0], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]

    def block(numbers: list[int] | np.ndarray, kind: str) -> bytes:
        values = np.asarray(numbers).ravel()
        return values.astype(kind).tobytes() if binary else " ".join(map(str, values)).encode()

    parts = [f"# vtk DataFile Version {version}", "pyramid", "BINARY" if binary else "ASCII"]
    out = "\n".join([*parts, "DATASET POLYDATA", "POINTS 5 float\n"]).encode() + block(points, ">f4")
    flat = [v for cell in cells for v in cell]
    if version == "3.0":
        sized = [v for cell in cells for v in (len(cell), *cell)]
        out += f"\nPOLYGONS {len(cells)} {len(sized)}\n".encode() + block(sized, ">i4")
    else:
        ends = np.cumsum([0] + [len(cell) for cell in cells])
        out += f"\nPOLYGONS {len(ends)} {len(flat)}\nOFFSETS vtktypeint64\n".encode() + block(ends, ">i8")
        out += b"\nCONNECTIVITY vtktypeint64\n" + block(flat, ">i8")
    path = tmp_path / "pyramid.vtk"
    path.write_bytes(out + b"\n")
    vertices, faces = vtk.read_vtk(path.read_bytes())
    np.testing.assert_array_equal(vertices, points)
    assert len(faces) == 6
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(4.0)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "DATASET STRUCTURED_POINTS\n",
        "DATASET POLYDATA\nPOINTS 2 float\n0 0 0\n",
        "DATASET POLYDATA\nPOINTS 1 float\n0 0 0\nPOLYGONS 1 4\n3 0 1 2\n",
    ],
)
def test_a_bad_vtk_file_is_refused_in_one_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.vtk"
    path.write_text(f"# vtk DataFile Version 3.0\n\nASCII\n{text}")
    with pytest.raises(UserError, match=r"bad\.vtk is no surface that can be read"):
        brain_surface.load_brain(path, OPENING)


def test_surface_is_merged_and_placed(egg: Path) -> None:
    surface = brain_surface.load_brain(egg, OPENING)
    assert len(surface.vertices) < 700
    assert surface.vertices[:, 2].max() == pytest.approx(0.0, abs=0.3)
    assert np.ptp(surface.vertices[:, 2]) == pytest.approx(64, rel=0.01)


def test_axes_are_a_rotation_with_z_outwards() -> None:
    for direction in [*np.eye(3).tolist(), [0.3, -0.5, 0.8]]:
        turn = brain_surface.axes(np.array(direction))
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(turn) == pytest.approx(1)
        assert turn[2] @ direction == pytest.approx(np.linalg.norm(direction))


@pytest.mark.slow
def test_open_surface_is_meshed_whole(egg: Path) -> None:
    anatomy = schema.Anatomy(mesh=egg, craniotomy=OPENING)
    tets = tetrahedra.from_brain(brain_surface.load_brain(egg, OPENING), anatomy, 800, 2)
    volume = bary_slope(tets.points[tets.cells[:, :4]])[1]
    assert volume.min() > 0
    # Faces lie on the surface in the mean, and not under it as chords.
    assert volume.sum() == pytest.approx(4 / 3 * np.pi * 32 * 26 * 22, rel=0.02)
    again = tetrahedra.from_brain(brain_surface.load_brain(egg, OPENING), anatomy, 800, 2)
    assert np.array_equal(tets.points, again.points)
    assert np.array_equal(tets.cells, again.cells)
    assert not tets.fixed.any()
    assert tets.hold.sum() > 0


def test_no_volume_and_no_surface_at_the_craniotomy_are_refused(egg: Path, tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.stl"
    trimesh.creation.box((50, 50, 0)).export(sheet)
    with pytest.raises(UserError, match="no volume"):
        brain_surface.load_brain(sheet, OPENING)
    with pytest.raises(UserError, match="no surface within"):
        brain_surface.load_brain(egg, schema.Craniotomy(point=(90.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0)))
    with pytest.raises(UserError, match="no such file"):
        brain_surface.load_brain(tmp_path / "none.obj", OPENING)
    torn = tmp_path / "torn.ply"
    torn.write_text("ply\nformat ascii 1.0\nelement vertex 3\n")
    with pytest.raises(UserError, match=r"torn\.ply"):
        brain_surface.load_brain(torn, OPENING)
