"""A user's surface: holes and duplicates, placement, meshing, and refused files."""

import base64
import struct
import sys
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command import run
from egg_brain import OPENING, soup, write_triangles

from synth.cli import app
from synth.errors import UserError
from synth.fem.mesh.element import bary_slope
from synth.geometry import brain_surface
from synth.geometry.skull import Craniotomy
from synth.job import schema
from synth.sequence.fem_mechanics import build_volume
from synth.sequence.simulation import simulate


@pytest.mark.parametrize("suffix", ["obj", "vtk"])
def test_a_messy_surface_of_every_format_is_meshed_and_moved(suffix: str, tmp_path: Path) -> None:
    path = write_triangles(tmp_path / f"egg.{suffix}", soup())
    job = schema.Job(
        frames=5,
        anatomy=schema.AnatomySection(mesh=path, vertices=2500, craniotomy=OPENING),
        fem=schema.FemSection(tets=600, load=0.1, gestures=("pull",)),
    )
    scene = simulate(job)
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
    egg = write_triangles(tmp_path / "egg.obj", soup())
    sheet, torn, bad = tmp_path / "sheet.stl", tmp_path / "torn.ply", tmp_path / "bad.vtk"
    trimesh.creation.box((50, 50, 0)).export(sheet)
    torn.write_text("ply\nformat ascii 1.0\nelement vertex 3\n")
    bad.write_text("# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\nPOINTS 2 float\n0 0 0\n")
    outside = Craniotomy(point=(90.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0))
    for path, opening in ((sheet, OPENING), (torn, OPENING), (bad, OPENING), (egg, outside)):
        with pytest.raises(UserError):
            brain_surface.load_brain(path, opening)


def test_holes_are_filled_on_request_and_surfaces_still_open_refused(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=30.0)
    centres = ball.triangles_center
    kept_faces = (centres[:, 0] > -20) & (np.linalg.norm(centres - [0.0, 0.0, 30.0], axis=1) > 5)
    holed_path = write_triangles(tmp_path / "holed.obj", ball.triangles[kept_faces])
    assert not trimesh.Trimesh(*brain_surface.read_brain(holed_path), process=False).is_watertight
    mesh = trimesh.Trimesh(*brain_surface.read_brain(holed_path, fill_holes=True), process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    # The ball without the cap that the flat fan cuts off, 10 mm high at most.
    cap = np.pi * 10**2 * (30 - 10 / 3)
    assert 4 / 3 * np.pi * 30**3 - 1.15 * cap < mesh.volume < ball.volume
    fin = np.concatenate([ball.triangles, [[*ball.triangles[0, :2], (0.0, 0.0, 90.0)]]])
    with pytest.raises(UserError, match=r"anatomy\.fill_holes"):
        brain_surface.read_brain(write_triangles(tmp_path / "fin.stl", fin), fill_holes=True)


BALL = trimesh.creation.icosphere(subdivisions=3)
WAVES = 1 + 0.03 * np.sin(9 * BALL.vertices[:, 0] + 1) * np.sin(8 * BALL.vertices[:, 1] + 2)
POINTS, FACES = BALL.vertices * WAVES[:, None] * [65, 85, 60], np.array(BALL.faces)
VOLUME = trimesh.Trimesh(POINTS, FACES, process=False).volume
HALF = BALL.triangles_center[:, 0] < 0
SLICER = b"3D Slicer output. SPACE=LPS"


def stl(head: bytes = SLICER, count: int = len(FACES), tail: bytes = b"", scale: float = 1.0) -> bytes:
    rows = np.zeros(len(FACES), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows["corners"] = scale * POINTS[FACES]
    return head.ljust(80) + struct.pack("<I", count) + rows.tobytes() + tail


def vtk() -> bytes:
    """Half of the faces as polygons, the others as strips: each one a triangle."""
    rows = [b"%d %d %d" % tuple(face) for face in FACES]
    lines = [b"# vtk DataFile Version 3.0", SLICER, b"ASCII", b"DATASET POLYDATA"]
    lines += [b"POINTS %d float" % len(POINTS), *(b"%f %f %f" % tuple(point) for point in POINTS)]
    for kind, mask in ((b"POLYGONS", HALF), (b"TRIANGLE_STRIPS", ~HALF)):
        lines.append(kind + b" %d %d" % (mask.sum(), 4 * mask.sum()))
        lines += [b"3 " + rows[k] for k in np.flatnonzero(mask)]
    return b"\n".join([*lines, b""])


def vtp(appended: bool) -> bytes:
    """As ParaView and 3D Slicer write it: compressed, in base64, or raw at the end of the file."""
    blobs = b""

    def encode_array(name: str, kind: str, values: np.ndarray, tag: str = "DataArray") -> bytes:
        nonlocal blobs
        data = values.astype(kind.lower().replace("string", "uint8")).tobytes()
        block = zlib.compress(data)
        head = np.array([1, len(data), 0, len(block)], "<u4").tobytes()
        offset, blobs = len(blobs), blobs + head + block
        payload = b"" if appended else base64.b64encode(head) + base64.b64encode(block)
        form = f'format="appended" offset="{offset}"' if appended else 'format="binary"'
        return f'<{tag} type="{kind}" Name="{name}" {form}>'.encode() + payload + f"</{tag}>".encode()

    cells = encode_array("connectivity", "Int64", FACES) + encode_array(
        "offsets", "Int32", 3 + 3 * np.arange(len(FACES))
    )
    space = encode_array("SPACE", "String", np.frombuffer(b"LPS\0", np.uint8), "Array")
    body = b"<FieldData>" + space + b"</FieldData><Piece><Points>" + encode_array("Points", "Float64", POINTS)
    body += b"</Points><Polys>" + cells + b"</Polys></Piece>"
    end = b'<AppendedData encoding="raw">\n_' + blobs + b"\n</AppendedData>" if appended else b""
    header = b'<VTKFile type="PolyData" byte_order="LittleEndian" compressor="vtkZLibDataCompressor">'
    return header + b"<PolyData>" + body + b"</PolyData>" + end + b"</VTKFile>"


LPS_FILES = [("stl", stl(tail=b"\n")), ("stl", stl(count=0)), ("vtk", vtk())]
LPS_FILES += [("vtp", vtp(appended)) for appended in (False, True)]


@pytest.mark.parametrize(("suffix", "data"), LPS_FILES)
def test_the_stated_space_becomes_ras_and_no_face_is_lost(suffix: str, data: bytes, tmp_path: Path) -> None:
    (tmp_path / f"brain.{suffix}").write_bytes(data)
    with pytest.warns(match="LPS"):
        vertices, faces = brain_surface.read_brain(tmp_path / f"brain.{suffix}")
    assert len(faces) == len(FACES)
    true = trimesh.Trimesh(POINTS * [-1, -1, 1], FACES)
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(true.volume, rel=1e-5)
    np.testing.assert_allclose(vertices.mean(axis=0), true.vertices.mean(axis=0), atol=1e-3)


OTHER_AXES = [((1, 1, 1), "accepted"), ((-1, -1, 1), "negated"), ((-1, 1, 1), "negated")]
OTHER_AXES += [((1.3, 1.3, 1.3), "nearest"), ((1, 1, 1), "direction")]


@pytest.mark.parametrize(("sign", "expected"), OTHER_AXES)
def test_an_opening_in_other_axes_is_refused(sign: tuple[float, ...], expected: str, tmp_path: Path) -> None:
    (tmp_path / "brain.stl").write_bytes(stl(b"no space"))
    outcomes = []
    for k in np.flatnonzero(BALL.vertices[:, 2] > 0.5)[::12]:
        point, direction = POINTS[k] * sign, BALL.vertices[k] * sign * (-1 if expected == "direction" else 1)
        try:
            opening = Craniotomy(point=tuple(point), direction=tuple(direction))
            brain_surface.load_brain(tmp_path / "brain.stl", opening)
            outcomes.append("accepted")
        except UserError as error:
            outcomes.append(str(error))
    # The two are where it is symmetric by chance.
    assert sum(expected not in outcome for outcome in outcomes) <= 2, outcomes


def test_faces_are_turned_until_neighbours_agree(tmp_path: Path) -> None:
    for flipped_faces in (HALF, np.arange(len(FACES)) % 10 < 3):
        faces = np.where(flipped_faces[:, None], FACES[:, ::-1], FACES)
        with warnings.catch_warnings(action="error"):
            mesh = brain_surface.read_brain(write_triangles(tmp_path / "brain.ply", POINTS[faces]))
        assert trimesh.Trimesh(*mesh, process=False).volume == pytest.approx(VOLUME, rel=1e-5)


@pytest.mark.parametrize(
    ("data", "pattern"),
    [(stl(scale=0.1), "by 10$"), (stl(scale=0.001), "by 1000$"), (stl()[:-50], str(len(FACES)))],
)
@pytest.mark.filterwarnings("ignore:.*LPS")
def test_a_true_reason_names_the_unit_or_the_count(data: bytes, pattern: str, tmp_path: Path) -> None:
    (tmp_path / "brain.stl").write_bytes(data)
    with pytest.raises(UserError, match=pattern):
        brain_surface.read_brain(tmp_path / "brain.stl")


def write_surface(path: Path, encoding: str = "B64GZ") -> bytes:
    """FreeSurfer's, or GIfTI with a matrix that scales to an atlas, as `mris_convert` writes it."""
    nibabel = pytest.importorskip("nibabel", reason="the extra `readers` is not installed")
    if path.suffix != ".gii":
        nibabel.freesurfer.write_geometry(path, POINTS, FACES)
        path.write_bytes(path.read_bytes() + b"valid = 1  # info valid\ncras   = 5.4 18 -3.5\n")
        return path.read_bytes()
    attributes = {"meta": nibabel.gifti.GiftiMetaData(VolGeomC_R="5.4", VolGeomC_A="18", VolGeomC_S="-3.5")}
    attributes |= {"coordsys": nibabel.gifti.GiftiCoordSystem(0, 3, 1.2 * np.eye(4)), "encoding": encoding}
    parts = {"POINTSET": np.float32(POINTS), "TRIANGLE": np.int32(FACES)}
    arrays = [
        nibabel.gifti.GiftiDataArray(values, f"NIFTI_INTENT_{k}", **attributes) for k, values in parts.items()
    ]
    nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), path)
    return path.read_bytes()


def test_neuroimaging_is_read_as_stored_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("lh.pial.T1", "ASCII.gii", "B64BIN.gii", "B64GZ.gii"):
        write_surface(tmp_path / name, name.removesuffix(".gii"))
        with pytest.warns(match=r"surface RAS.*\[5\.4, 18\.0, -3\.5\]"):
            vertices, faces = brain_surface.read_brain(tmp_path / name)
        np.testing.assert_allclose(vertices[faces], POINTS[FACES], atol=1e-4)
    gii, pial = write_surface(tmp_path / "a.gii"), write_surface(tmp_path / "a.pial")
    cases = [(b"\xff\xff\xff" + pial[3:], "pial"), (pial[:5000], "readable"), (gii[:5000], "readable")]
    for data, pattern in [*cases, (gii.replace(b"POINTSET", b"SHAPE"), "surf.gii"), (gii, "pip install nib")]:
        (path := tmp_path / ("a.gii" if data[:1] == gii[:1] else "lh.thickness")).write_bytes(data)
        monkeypatch.setitem(sys.modules, "nibabel", None if "pip" in pattern else sys.modules["nibabel"])
        with pytest.raises(UserError, match=rf"^.*{pattern}.*\Z"):
            brain_surface.read_brain(path)


def test_arrays_that_expand_without_bound_are_refused(tmp_path: Path) -> None:
    """A GIfTI file of a megabyte whose points expand to 1.1 GB."""
    gii = write_surface(tmp_path / "B64GZ.gii", "B64GZ")
    packer = zlib.compressobj(1)
    bomb = b"".join(packer.compress(bytes(1 << 24)) for _ in range(66)) + packer.flush()
    start, end = gii.index(b"<Data>") + 6, gii.index(b"</Data>")
    (tmp_path / "a.gii").write_bytes(gii[:start] + base64.b64encode(bomb) + gii[end:])
    with pytest.raises(UserError, match="1 GB"):
        brain_surface.read_brain(tmp_path / "a.gii")


@pytest.mark.trial
def test_openings_of_fsaverage5_are_found_and_rendered(tmp_path: Path) -> None:
    nibabel, pattern = pytest.importorskip("nibabel"), "nilearn/datasets/data/fsaverage5/pial_[lr]*.gii.gz"
    if len(files := [file for home in sys.path for file in Path(home).glob(pattern)]) != 2:
        pytest.skip("fsaverage5 is not there: pip install --no-deps nilearn")
    brain = trimesh.util.concatenate([trimesh.Trimesh(*nibabel.load(file).agg_data()) for file in files])
    nibabel.freesurfer.write_geometry(path := tmp_path / "both.pial", brain.vertices, brain.faces)
    job = path.with_name("job.yaml")
    job.write_text(run(app, "preview", path, "-n", 2, "-o", tmp_path / "a.png").stdout)
    run(app, "render", job, "-o", tmp_path / "out", "sequences=1", "frames=3", "fem.tets=800", "render.spp=2")
