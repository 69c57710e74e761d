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


def rod(ends: tuple[tuple[float, ...], ...] = (TIP, HAND), radius: float = 1.5) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius, segment=ends, sections=24)


def job_of(file: Path, **keys: object) -> Job:
    tool = {"file": file, "tip": TIP, **keys}
    line = {"gesture": "push", "instrument": tool, "place": [0, 0], "direction": [0, 0, -1]}
    render = {"size": [96, 72], "spp": 4, "variant": "scalar_rgb"}
    given = {"frames": 4, "anatomy": {"vertices": 2500}, "render": render}
    return Job.model_validate({**given, "fem": {"tets": 300, "instrument_list": [line]}})


def test_a_mesh_is_placed_by_tip_axis_side_and_unit() -> None:
    mesh = rod(((0.02, 0.0, 0.0), (0.02, -0.1, 0.0)), 0.001)
    placed = place_mesh(mesh.vertices, mesh.faces, (0.02, 0, 0), (0, -2, 0), (1, 0.5, 0), 1000.0)
    assert placed[:, 2].min() == pytest.approx(0, abs=1e-9)
    assert placed[:, 2].max() == pytest.approx(100)
    np.testing.assert_allclose(placed[:, 0], 1000 * (mesh.vertices[:, 0] - 0.02), atol=1e-9)  # up
    sides = placed[mesh.faces]
    volume = np.einsum("fc,fc->f", sides[:, 0], np.cross(sides[:, 1], sides[:, 2])).sum() / 6
    assert volume == pytest.approx(1e9 * mesh.volume)  # turned, not mirrored


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "STL"])
def test_formats_give_one_shape(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"rod.{suffix}"
    file.write_bytes(
        trimesh.exchange.export.export_mesh(rod(), None, suffix.lower())
        if suffix != "obj"
        else trimesh.exchange.obj.export_obj(rod()).encode()
    )
    own = read_job_instruments(job_of(file).fem)[file.name]
    corners = own.part.profile[own.part.shape.faces]
    volume = np.einsum("fc,fc->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(rod().volume, rel=1e-5)
    assert len(own.part.profile) > len(rod().vertices)  # the rim of its end stays sharp
    assert own.half == pytest.approx(1.5, rel=0.05)


def test_faces_that_turn_inwards_are_turned(tmp_path: Path) -> None:
    mesh = rod()
    trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False).export(tmp_path / "in.stl")
    shape = read_job_instruments(job_of(tmp_path / "in.stl").fem)["in.stl"].part.shape
    assert trimesh.Trimesh(*shape, process=False).volume == pytest.approx(mesh.volume, rel=1e-5)


def test_an_outline_encloses_its_mesh() -> None:
    mesh = trimesh.util.concatenate([rod(((0, 0, 0), (0, 0, 60))), rod(((0, 0, 60), (30, 0, 110)))])
    rings = outline_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)).reshape(-1, 32, 3)
    points = trimesh.sample.sample_surface(mesh, 2000, seed=0)[0]
    middle, radius = rings.mean(axis=1), np.linalg.norm(rings - rings.mean(axis=1)[:, None], axis=2)[:, 0]
    slice_ = np.abs(points[:, 2:] - middle[:, 2]).argmin(axis=1)
    away = np.linalg.norm(points[:, :2] - middle[slice_, :2], axis=1)
    assert (away <= radius[slice_] + 1e-6).all()
    assert radius.max() < 6  # of a leaning rod of 1.5 mm, in slices of 2.3 mm


def test_its_texture_is_placed_as_that_of_the_rings_around_it() -> None:
    mesh = rod(((1, 2, 0), (1, 2, 60)))
    outline = outline_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    own = Part(np.asarray(mesh.vertices), 0, faces=np.asarray(mesh.faces, np.int32), outline=outline)
    ends = np.interp(own.profile[:, 2], [0, 60], [0.5 / 49, 48.5 / 49])
    np.testing.assert_allclose(own.uv[:, 0], ends, atol=1e-6)  # linear in z
    np.testing.assert_allclose(wrap(outline, outline), unfold(outline, 0), atol=1e-6)
    maps = own.maps(Finish((0.6, 0.6, 0.6), 0.2), "rod.stl", np.random.default_rng(0), 0.1)
    assert np.isfinite(maps.base).all()
    np.testing.assert_allclose(own.resize(2.0).uv, own.uv, atol=1e-6)


def damaged(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-100])


def endless(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def heavy(file: Path) -> None:
    with file.open("r+b") as out:
        out.truncate(65 << 20)


def infinite(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[96:100] = np.float32(np.inf).tobytes()  # x of the first face's first corner
    file.write_bytes(data)


def flat(file: Path) -> None:
    file.write_bytes(
        trimesh.exchange.stl.export_stl(trimesh.Trimesh([TIP, HAND, TIP], [[0, 1, 2]], process=False))
    )


def empty(file: Path) -> None:
    file.write_bytes(b"solid x\nendsolid x\n")


def fine(file: Path) -> None:
    trimesh.creation.icosphere(7, 40).export(file)


@pytest.mark.parametrize("spoil", [damaged, endless, heavy, infinite, flat, empty, fine, Path.unlink])
def test_files_that_are_no_instrument_are_refused(tmp_path: Path, spoil: object) -> None:
    file = tmp_path / "rod.stl"
    rod().export(file)
    spoil(file)  # type: ignore[operator]
    with pytest.raises(UserError) as refused:
        draw_scenario(job_of(file), 0)
    assert "\n" not in str(refused.value)
    assert "rod.stl" in str(refused.value)


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
    rod().export(tmp_path / "rod.stl")
    with pytest.raises(UserError) as refused:
        draw_scenario(job_of(tmp_path / "rod.stl", **keys), 0)
    assert "\n" not in str(refused.value)


def test_a_short_mesh_is_doubted(tmp_path: Path) -> None:
    rod((TIP, (5.0, -3.0, 32.0))).export(tmp_path / "stub.stl")
    with pytest.warns(Caution, match="30 mm"):
        draw_scenario(job_of(tmp_path / "stub.stl"), 0)


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
    rod().export(tmp_path / "rod.stl")
    (tmp_path / "job.yaml").write_text(f"fem: {text}\n")
    (tmp_path / "rod.step").write_text("ISO-10303-21;")
    with pytest.raises(UserError) as refused:
        draw_scenario(tmp_path / "job.yaml", 0)
    assert "\n" not in str(refused.value)


def test_paths_start_at_the_job_and_content_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        rod().export(folder / "rod.stl")
        tool = "{file: rod.stl, tip: [5, -3, 2]}"
        (folder / "job.yaml").write_text(f"fem:\n  instrument: [probe, {tool}]\n  gestures: [push]\n")
        jobs.append(reader.load_job(folder / "job.yaml"))
    first, second = map(identity.identify_job, jobs)
    assert first == second
    assert first != identity.identify_job(Job())
    assert identity.identify_job(Job.model_validate_json(jobs[0].model_dump_json())) == first  # as workers do
    (tmp_path / "c.yaml").write_text(job_writer.dump_job(jobs[0]))
    assert reader.load_job(tmp_path / "c.yaml") == jobs[0]
    names = {draw_scenario(jobs[0], k).gestures[0].instrument for k in range(12)}
    assert names == {"probe", "rod.stl"}
    rod(radius=1.6).export(tmp_path / "b" / "rod.stl")
    assert identity.identify_job(jobs[1]) != first
    moved = jobs[0].fem.instrument[1].model_copy(update={"tip": (5.0, -3.0, 2.1)})  # type: ignore[union-attr]
    fem = jobs[0].fem.model_copy(update={"instrument": (moved,)})
    assert identity.identify_job(jobs[0].model_copy(update={"fem": fem})) != first
    monkeypatch.chdir(tmp_path / "b")
    given = reader.load_job(tmp_path / "a" / "job.yaml", ["fem.instrument=rod.stl"])
    assert given.fem.own_instruments["rod.stl"].file == tmp_path / "b" / "rod.stl"
    (tmp_path / "a" / "job.yaml").write_text("fem: {instrument_list: [{instrument: rod.stl}]}")
    given = reader.load_job(tmp_path / "a" / "job.yaml")
    assert given.fem.own_instruments["rod.stl"].file == tmp_path / "a" / "rod.stl"
    assert json.loads(given.model_dump_json())["fem"]["instrument_list"][0]["instrument"]["unit_mm"] == 1


def test_it_is_drawn_and_shades_where_it_touches(tmp_path: Path) -> None:
    rod().export(tmp_path / "rod.stl")
    job = job_of(tmp_path / "rod.stl")
    rest = at_rest(job)
    gesture = rest.scenario.gestures[0]
    under = rest.surface.vertices[np.hypot(*rest.surface.vertices[:, :2].T).argmin()]
    tips, shafts = np.stack([under, under]), np.stack([gesture.shaft, gesture.shaft])
    (vertices,) = place([read_job_instruments(job.fem)["rod.stl"].part], tips, shafts)
    end = vertices[np.linalg.norm(vertices - under, axis=1) < 2]
    np.testing.assert_allclose(end.mean(axis=0), under, atol=0.3)  # its end's rim is around the contact
    shown = rest.renderer.render(SceneState(rest.surface.vertices, tips, shafts), 0)
    gone = rest.renderer.render(SceneState(rest.surface.vertices, tips + 500 * shafts[:1], shafts), 0)
    pixels = np.stack(np.indices((72, 96))[::-1], axis=-1)
    sides = ConvexHull(project(rest.view, vertices)).equations
    drawn = (pixels @ sides[:, :2].T + sides[:, 2] <= 0).all(axis=2)
    end_px = np.linalg.norm(pixels - project(rest.view, under[None])[0], axis=2)
    free = end_px * rest.view.mm_per_px > 2.5  # where its end is not in the tissue
    both, either = drawn & shown.tool & free, (drawn | shown.tool) & free
    assert both.sum() > 0.98 * either.sum()
    assert end_px[shown.tool].min() * rest.view.mm_per_px < 1.0
    assert not gone.tool.any()
    beside = binary_dilation(drawn, iterations=4) & ~binary_dilation(drawn, iterations=1)
    light = [one.radiance[beside & rest.tissue].mean() for one in (shown, gone)]
    assert light[0] < 0.95 * light[1]  # in its shadow


@pytest.mark.slow
def test_parts_and_workers_draw_it(tmp_path: Path) -> None:
    rod().export(tmp_path / "rod.stl")
    job = job_of(tmp_path / "rod.stl").model_copy(update={"sequences": 2})
    whole = render_job(job, tmp_path / "whole", workers=1)
    parts = [render_job(job, tmp_path / "parts", workers=1, part=dataset_folder.Part(k, 2)) for k in (1, 2)]
    assert not whole.failed
    assert parts[1].content_hash == whole.content_hash
    rod(radius=1.0).export(tmp_path / "rod.stl")
    with pytest.raises(UserError):
        render_job(job, tmp_path / "whole", workers=1)
