"""Instruments of one's own: read, placed, drawn where they touch; part of the identity; bad ones refused."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation
from scipy.spatial import ConvexHull

from synth.dataset import dataset_folder
from synth.engine.run import render_job
from synth.errors import Caution, UserError
from synth.job import identity, job_writer, reader
from synth.job.schema import Job
from synth.render.camera.camera import project
from synth.render.finish import Finish
from synth.render.finish_maps import unfold, wrap
from synth.render.instrument import Part, place
from synth.render.instrument_file import outline_mesh, place_mesh
from synth.render.scene import SceneState
from synth.sequence.draw import draw_scenario
from synth.sequence.job_instruments import read_job_instruments
from synth.sequence.rest_scene import at_rest

TIP, HAND = (5.0, -3.0, 2.0), (5.0, -3.0, 122.0)


def make_rod(ends: tuple[tuple[float, ...], ...] = (TIP, HAND), radius: float = 1.5) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius, segment=ends, sections=24)


def make_job(file: Path, **keys: object) -> Job:
    tool = {"file": file, "tip": TIP, **keys}
    line = {"gesture": "push", "instrument": tool, "place": [0, 0], "direction": [0, 0, -1]}
    render = {"size": [96, 72], "spp": 4, "variant": "scalar_rgb"}
    sections = {"frames": 4, "anatomy": {"vertices": 2500}, "render": render}
    return Job.model_validate({**sections, "fem": {"tets": 300, "instrument_list": [line]}})


def test_a_mesh_is_placed_by_tip_axis_side_and_unit() -> None:
    mesh = make_rod(((0.02, 0.0, 0.0), (0.02, -0.1, 0.0)), 0.001)
    vertices = place_mesh(mesh.vertices, mesh.faces, (0.02, 0, 0), (0, -2, 0), (1, 0.5, 0), 1000.0)
    assert vertices[:, 2].min() == pytest.approx(0, abs=1e-9)
    assert vertices[:, 2].max() == pytest.approx(100)
    np.testing.assert_allclose(vertices[:, 0], 1000 * (mesh.vertices[:, 0] - 0.02), atol=1e-9)  # up
    triangles = vertices[mesh.faces]
    volume = np.einsum("fc,fc->f", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6
    assert volume == pytest.approx(1e9 * mesh.volume)  # turned, not mirrored


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "STL"])
def test_formats_give_one_shape(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"rod.{suffix}"
    file.write_bytes(
        trimesh.exchange.export.export_mesh(make_rod(), None, suffix.lower())
        if suffix != "obj"
        else trimesh.exchange.obj.export_obj(make_rod()).encode()
    )
    instrument = read_job_instruments(make_job(file).fem)[file.name]
    corners = instrument.part.profile[instrument.part.shape.faces]
    volume = np.einsum("fc,fc->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(make_rod().volume, rel=1e-5)
    assert len(instrument.part.profile) > len(make_rod().vertices)  # the rim of its end stays sharp
    assert instrument.half == pytest.approx(1.5, rel=0.05)


def test_faces_that_turn_inwards_are_turned(tmp_path: Path) -> None:
    mesh = make_rod()
    trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False).export(tmp_path / "in.stl")
    shape = read_job_instruments(make_job(tmp_path / "in.stl").fem)["in.stl"].part.shape
    assert trimesh.Trimesh(*shape, process=False).volume == pytest.approx(mesh.volume, rel=1e-5)


def test_an_outline_encloses_its_mesh() -> None:
    mesh = trimesh.util.concatenate([make_rod(((0, 0, 0), (0, 0, 60))), make_rod(((0, 0, 60), (30, 0, 110)))])
    rings = outline_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)).reshape(-1, 32, 3)
    points = trimesh.sample.sample_surface(mesh, 2000, seed=0)[0]
    centres, radius = rings.mean(axis=1), np.linalg.norm(rings - rings.mean(axis=1)[:, None], axis=2)[:, 0]
    slice_ = np.abs(points[:, 2:] - centres[:, 2]).argmin(axis=1)
    distance = np.linalg.norm(points[:, :2] - centres[slice_, :2], axis=1)
    assert (distance <= radius[slice_] + 1e-6).all()
    assert radius.max() < 6  # of a leaning rod of 1.5 mm, in slices of 2.3 mm


def test_its_texture_is_placed_as_that_of_the_rings_around_it() -> None:
    mesh = make_rod(((1, 2, 0), (1, 2, 60)))
    outline = outline_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    part = Part(np.asarray(mesh.vertices), 0, faces=np.asarray(mesh.faces, np.int32), outline=outline)
    ends = np.interp(part.profile[:, 2], [0, 60], [0.5 / 49, 48.5 / 49])
    np.testing.assert_allclose(part.uv[:, 0], ends, atol=1e-6)  # linear in z
    np.testing.assert_allclose(wrap(outline, outline), unfold(outline, 0), atol=1e-6)
    maps = part.maps(Finish((0.6, 0.6, 0.6), 0.2), "rod.stl", np.random.default_rng(0), 0.1)
    assert np.isfinite(maps.base).all()
    np.testing.assert_allclose(part.resize(2.0).uv, part.uv, atol=1e-6)


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-100])


def replace_by_pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def make_heavy(file: Path) -> None:
    with file.open("r+b") as out:
        out.truncate(65 << 20)


def put_infinity(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[96:100] = np.float32(np.inf).tobytes()  # x of the first face's first corner
    file.write_bytes(data)


def flatten(file: Path) -> None:
    file.write_bytes(
        trimesh.exchange.stl.export_stl(trimesh.Trimesh([TIP, HAND, TIP], [[0, 1, 2]], process=False))
    )


def remove_faces(file: Path) -> None:
    file.write_bytes(b"solid x\nendsolid x\n")


def refine(file: Path) -> None:
    trimesh.creation.icosphere(7, 40).export(file)


@pytest.mark.parametrize(
    "spoil", [truncate, replace_by_pipe, make_heavy, put_infinity, flatten, remove_faces, refine, Path.unlink]
)
def test_files_that_are_no_instrument_are_refused(tmp_path: Path, spoil: object) -> None:
    file = tmp_path / "rod.stl"
    make_rod().export(file)
    spoil(file)  # type: ignore[operator]
    with pytest.raises(UserError) as error:
        draw_scenario(make_job(file), 0)
    assert "\n" not in str(error.value)
    assert "rod.stl" in str(error.value)


@pytest.mark.parametrize(
    "keys",
    [
        {"unit_mm": 0.001},  # a rod of a tenth of a millimetre
        {"unit_mm": 1000},
        {"tip": (0, 0, 0)},  # 5 mm from it
        {"axis": (0, 0, -1)},
        {"axis": (1, 0, 0)},  # across it
        {"up": (0, 0, 1)},
    ],
)
def test_a_place_that_does_not_fit_is_refused(tmp_path: Path, keys: dict[str, object]) -> None:
    make_rod().export(tmp_path / "rod.stl")
    with pytest.raises(UserError) as error:
        draw_scenario(make_job(tmp_path / "rod.stl", **keys), 0)
    assert "\n" not in str(error.value)


def test_a_short_mesh_is_doubted(tmp_path: Path) -> None:
    make_rod((TIP, (5.0, -3.0, 32.0))).export(tmp_path / "stub.stl")
    with pytest.warns(Caution, match="30 mm"):
        draw_scenario(make_job(tmp_path / "stub.stl"), 0)


@pytest.mark.parametrize(
    "text",
    [
        "{instrument: rod.step}",
        "{instrument: missing.stl}",
        "{instrument: {file: rod.stl, tips: [0, 0, 0]}}",
        "{instrument: {tip: [0, 0, 0]}}",
        "{instrument: {file: rod.stl, axis: [0, 0, 0]}}",
        "{instrument: rod.stl, gestures: [grasp]}",
        "{instrument: [rod.stl, {file: rod.stl, tip: [5, -3, 2]}]}",
        "{instrument: 3}",
    ],
)
def test_keys_that_are_wrong_are_refused_in_a_line(tmp_path: Path, text: str) -> None:
    make_rod().export(tmp_path / "rod.stl")
    (tmp_path / "job.yaml").write_text(f"fem: {text}\n")
    (tmp_path / "rod.step").write_text("ISO-10303-21;")
    with pytest.raises(UserError) as error:
        draw_scenario(tmp_path / "job.yaml", 0)
    assert "\n" not in str(error.value)


def test_paths_start_at_the_job_and_content_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        make_rod().export(folder / "rod.stl")
        tool = "{file: rod.stl, tip: [5, -3, 2]}"
        (folder / "job.yaml").write_text(f"fem:\n  instrument: [probe, {tool}]\n  gestures: [push]\n")
        jobs.append(reader.load_job(folder / "job.yaml"))
    first_identity, second_identity = map(identity.identify_job, jobs)
    assert first_identity == second_identity
    assert first_identity != identity.identify_job(Job())
    # As workers do.
    assert identity.identify_job(Job.model_validate_json(jobs[0].model_dump_json())) == first_identity
    (tmp_path / "c.yaml").write_text(job_writer.dump_job(jobs[0]))
    assert reader.load_job(tmp_path / "c.yaml") == jobs[0]
    names = {draw_scenario(jobs[0], k).gestures[0].instrument for k in range(12)}
    assert names == {"probe", "rod.stl"}
    make_rod(radius=1.6).export(tmp_path / "b" / "rod.stl")
    assert identity.identify_job(jobs[1]) != first_identity
    moved_tool = jobs[0].fem.instrument[1].model_copy(update={"tip": (5.0, -3.0, 2.1)})  # type: ignore[union-attr]
    fem = jobs[0].fem.model_copy(update={"instrument": (moved_tool,)})
    assert identity.identify_job(jobs[0].model_copy(update={"fem": fem})) != first_identity
    monkeypatch.chdir(tmp_path / "b")
    job = reader.load_job(tmp_path / "a" / "job.yaml", ["fem.instrument=rod.stl"])
    assert job.fem.own_instruments["rod.stl"].file == tmp_path / "b" / "rod.stl"
    (tmp_path / "a" / "job.yaml").write_text("fem: {instrument_list: [{instrument: rod.stl}]}")
    job = reader.load_job(tmp_path / "a" / "job.yaml")
    assert job.fem.own_instruments["rod.stl"].file == tmp_path / "a" / "rod.stl"
    assert json.loads(job.model_dump_json())["fem"]["instrument_list"][0]["instrument"]["unit_mm"] == 1


def test_it_is_drawn_and_shades_where_it_touches(tmp_path: Path) -> None:
    make_rod().export(tmp_path / "rod.stl")
    job = make_job(tmp_path / "rod.stl")
    rest = at_rest(job)
    gesture = rest.scenario.gestures[0]
    contact_point = rest.surface.vertices[np.hypot(*rest.surface.vertices[:, :2].T).argmin()]
    tips, shafts = np.stack([contact_point, contact_point]), np.stack([gesture.shaft, gesture.shaft])
    (vertices,) = place([read_job_instruments(job.fem)["rod.stl"].part], tips, shafts)
    tip_vertices = vertices[np.linalg.norm(vertices - contact_point, axis=1) < 2]
    # Its end's rim is around the contact.
    np.testing.assert_allclose(tip_vertices.mean(axis=0), contact_point, atol=0.3)
    shot = rest.renderer.render(SceneState(rest.surface.vertices, tips, shafts), 0)
    empty_shot = rest.renderer.render(SceneState(rest.surface.vertices, tips + 500 * shafts[:1], shafts), 0)
    pixels = np.stack(np.indices((72, 96))[::-1], axis=-1)
    sides = ConvexHull(project(rest.view, vertices)).equations
    outline = (pixels @ sides[:, :2].T + sides[:, 2] <= 0).all(axis=2)
    distance_px = np.linalg.norm(pixels - project(rest.view, contact_point[None])[0], axis=2)
    free = distance_px * rest.view.mm_per_px > 2.5  # where its end is not in the tissue
    intersection, union = outline & shot.tool & free, (outline | shot.tool) & free
    assert intersection.sum() > 0.98 * union.sum()
    assert distance_px[shot.tool].min() * rest.view.mm_per_px < 1.0
    assert not empty_shot.tool.any()
    border = binary_dilation(outline, iterations=4) & ~binary_dilation(outline, iterations=1)
    light = [frame.radiance[border & rest.tissue].mean() for frame in (shot, empty_shot)]
    assert light[0] < 0.95 * light[1]  # in its shadow


@pytest.mark.trial
def test_parts_and_workers_draw_it(tmp_path: Path) -> None:
    make_rod().export(tmp_path / "rod.stl")
    job = make_job(tmp_path / "rod.stl").model_copy(update={"sequences": 2, "frames": 3})
    whole = render_job(job, tmp_path / "whole", workers=1)
    parts = [render_job(job, tmp_path / "parts", workers=1, part=dataset_folder.Part(k, 2)) for k in (1, 2)]
    assert not whole.failed
    assert parts[1].content_hash == whole.content_hash
    make_rod(radius=1.0).export(tmp_path / "rod.stl")
    with pytest.raises(UserError):
        render_job(job, tmp_path / "whole", workers=1)
