"""Openings of a brain: found where they are, not where they can't be, drawn, and their lines make a job."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from egg_brain import soup, written
from ruamel.yaml import YAML
from typer.testing import CliRunner

import synth
from synth.cli import app
from synth.geometry import brain_surface
from synth.job import identity, writer
from synth.job.reader import parse_job
from synth.job.schema import Anatomy, Craniotomy
from synth.place import openings, page, picture
from synth.render.anatomy import survey
from synth.render.anatomy.survey import Ground
from synth.sequence import scenario, scene

pytestmark = pytest.mark.slow

RADIUS = 8.0


@pytest.fixture(scope="module")
def egg(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("place") / "egg.stl", soup())


@pytest.fixture(scope="module")
def found(egg: Path) -> openings.Survey:
    return openings.find_openings(egg, RADIUS, 3)


def test_an_eggs_openings_look_straight_out_of_it(found: openings.Survey) -> None:
    assert len(found.chosen) == 3
    for site in found.chosen:
        on = (site.point / [32.0, 26.0, 22.0]) @ (site.point / [32.0, 26.0, 22.0])
        assert on == pytest.approx(1.0, abs=0.06), "it is on the surface"
        normal = site.point / np.square([32.0, 26.0, 22.0])
        assert site.direction @ normal / np.linalg.norm(normal) > np.cos(np.radians(6))
        assert site.relief_mm < 0.4
        assert site.filled > 0.9
    for k, one in enumerate(found.chosen):
        for other in found.chosen[:k]:
            assert np.linalg.norm(one.point - other.point) >= 1.5 * RADIUS


def test_of_a_box_the_middles_of_its_sides_are_best() -> None:
    box = trimesh.creation.box((60, 60, 60)).subdivide().subdivide().subdivide()
    sites = survey.survey(Ground(np.asarray(box.vertices), np.asarray(box.faces)), 12.0)
    works = [site for site in sites if not site.fault]
    assert len(works) > 6
    assert all(site.cut for site in works), "flat as a cut"
    for site in survey.apart(works, 18.0)[:6]:
        assert np.abs(site.direction).max() > np.cos(np.radians(5))
        assert np.sort(np.abs(site.point))[1] < 20
    corners = [site for site in sites if np.abs(site.point).min() > 26]
    assert corners
    assert all(site.fault for site in corners)


def test_a_cleft_is_not_opened_and_what_is_round_it_is() -> None:
    """Two halves with a gap between them, as hemispheres: openings stay off the middle."""
    halves = []
    for side in (-1, 1):
        ball = trimesh.creation.icosphere(subdivisions=4)
        ball.vertices = ball.vertices * [24, 40, 36] + [side * 26, 0, 0]
        halves.append(ball)
    brain = trimesh.util.concatenate(halves)
    ground = Ground(np.asarray(brain.vertices), np.asarray(brain.faces))
    over = ground.judge(np.array([4.0, 0.0, 30.0]), np.array([0.0, 0.0, 1.0]), 12.0, turned=False)
    assert over.fault
    assert not ground.judge(np.array([26.0, 0.0, 36.0]), np.array([0.0, 0.0, 1.0]), 12.0).fault
    best = [site for site in survey.survey(ground, 12.0) if not site.fault]
    assert min(abs(site.point[0]) for site in best if site.direction[2] > 0.7) > 8


def test_nowhere_is_said(egg: Path) -> None:
    with pytest.raises(
        synth.UserError, match=r"egg\.stl: nowhere an opening of 40 mm radius works .*lower the radius"
    ):
        openings.find_openings(egg, 40.0, 3)


def test_an_impossible_place_names_the_nearest_that_is_possible(egg: Path) -> None:
    asked = np.array([60.0, 5.0, 0.0])
    job = synth.Job(
        frames=2,
        anatomy=Anatomy(
            mesh=egg,
            vertices=2500,
            craniotomy=Craniotomy(point=tuple(asked), direction=(1.0, 0.0, 0.0), radius_mm=RADIUS),
        ),
    )
    with pytest.raises(synth.UserError, match=r"no surface within 8 mm.* mm away it works: point:") as raised:
        scene.cortex(job, scenario.draw(job, 0))
    assert len(str(raised.value).splitlines()) == 1
    said = re.search(
        r"; ([\d.]+) mm away it works: point: (\[.*?\]), direction: (\[.*?\])", str(raised.value)
    )
    assert said is not None
    point, direction = (json.loads(said[k]) for k in (2, 3))
    assert np.linalg.norm(np.array(point) - asked) == pytest.approx(float(said[1]), rel=0.02)
    assert np.linalg.norm(np.array(point) - asked) < 1.15 * np.linalg.norm([60 - 31.5, 0]), (
        "about the nearest"
    )
    there = Craniotomy(point=tuple(point), direction=tuple(direction), radius_mm=RADIUS)
    good = job.model_copy(update={"anatomy": job.anatomy.model_copy(update={"craniotomy": there})})
    surface, whole = scene.cortex(good, scenario.draw(good, 0))
    assert whole is not None
    assert len(surface.vertices) == 2500


def test_where_nothing_works_the_message_says_so(egg: Path) -> None:
    there = Craniotomy(point=(31.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0), radius_mm=45.0)
    job = synth.Job(frames=2, anatomy=Anatomy(mesh=egg, vertices=2500, craniotomy=there))
    with pytest.raises(synth.UserError, match=r"nowhere on egg\.stl an opening of that radius works"):
        scene.cortex(job, scenario.draw(job, 0))


def test_the_command_leaves_a_picture_a_page_and_a_job_that_works(egg: Path, tmp_path: Path) -> None:
    brain = shutil.copy(egg, tmp_path / "egg.stl")
    words = ["place", str(brain), "--radius", f"{RADIUS:g}", "--count", "2", "--out", str(tmp_path / "where")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert sorted(path.name for path in (tmp_path / "where").iterdir()) == [
        "job.yaml",
        "openings.html",
        "openings.png",
    ]
    assert len(re.findall(r"^\d+ +\[", done.stdout, re.MULTILINE)) == 2
    text = (tmp_path / "where/job.yaml").read_text("utf-8")
    assert text.partition("\n")[2].partition("    # also")[0] in done.stdout
    job = synth.load_job(str(tmp_path / "where/job.yaml"), ["anatomy.vertices=2500", "fem.tets=400"])
    assert job.anatomy.mesh == tmp_path / "egg.stl"
    scene.build(job, scenario.draw(job, 0))
    (tmp_path / "where/job.yaml").write_text(text.replace("    # ", "    "))
    both = synth.load_job(str(tmp_path / "where/job.yaml")).anatomy.craniotomy
    assert len(both.also) == 1
    assert both.also[0].point != both.point
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 2
    assert "job.yaml: exists already" in again.output


def test_a_brain_of_an_odd_name_gives_lines_that_can_be_read(found: openings.Survey, tmp_path: Path) -> None:
    odd = tmp_path / 'a: brain #2 "x".obj'
    read = YAML(typ="safe").load(openings.lines(odd, found.chosen[0], RADIUS, tmp_path))
    assert read["anatomy"]["mesh"] == odd.name


def test_what_is_no_brain_is_one_line(tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.stl"
    trimesh.creation.box((50, 50, 0)).export(sheet)
    done = CliRunner().invoke(app, ["place", str(sheet), "--out", str(tmp_path / "out")])
    assert done.exit_code == 2
    assert done.output.strip() == "error: anatomy.mesh: sheet.stl encloses no volume"
    assert not (tmp_path / "out").exists()


def test_an_open_sheet_is_told_from_a_brain_with_holes(found: openings.Survey) -> None:
    assert not found.note, "the egg lacks a few faces"
    half = found.faces[(found.vertices[found.faces][:, :, 2] > 0).all(axis=1)]
    sheet = openings.Survey(found.path, found.vertices, half, RADIUS, found.chosen, ())
    rim = np.pi * (3 * (32 + 26) - np.sqrt((3 * 32 + 26) * (32 + 3 * 26)))  # Ramanujan's ellipse
    told = re.findall(r"egg\.stl is open along (\d+) mm", sheet.note)
    assert rim < float(told[0]) < 1.5 * rim, "it goes along edges, in a zigzag"


def test_the_wall_that_a_brain_was_cut_at_is_no_cortex(tmp_path: Path) -> None:
    """Half an egg: its flat side is the evenest place of all, and not where a brain is opened."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.vertices = np.maximum(ball.vertices * (40.0, 36.0, 34.0), [-np.inf, -np.inf, 0.0])
    ball.export(tmp_path / "half.stl")
    half = openings.find_openings(tmp_path / "half.stl", RADIUS, 4)
    cut = [site for site in (*half.chosen, *half.others) if site.cut and not site.fault]
    assert cut
    assert all(site.direction[2] < -0.99 for site in cut)
    assert min(site.relief_mm for site in cut) < min(site.relief_mm for site in half.chosen)
    assert not any(site.cut for site in half.chosen)


def test_the_page_offers_the_lines_of_every_place_that_works(found: openings.Survey, tmp_path: Path) -> None:
    text = page.render_page(found, tmp_path)
    told = json.loads(re.search(r"^const data = (.*);$", text, re.M)[1].replace("<\\/", "</"))  # type: ignore[index]
    assert [site["rank"] for site in told["sites"][:4]] == [1, 2, 3, 0]
    for site in told["sites"]:
        assert bool(site["lines"]) != bool(site["fault"])
    read = YAML(typ="safe").load(told["sites"][0]["lines"])["anatomy"]
    assert read["craniotomy"]["point"] == pytest.approx(found.chosen[0].point.tolist(), abs=0.006)
    assert read["craniotomy"]["radius_mm"] == RADIUS
    assert (tmp_path / read["mesh"]).resolve() == found.path.resolve()
    assert not re.search(r"(src|href)=[\"']?https?:", text.partition("<script>")[0])
    corners = np.array(told["x"])
    assert np.ptp(corners, axis=1) == pytest.approx([64, 52, 44], abs=0.5)
    assert np.array(told["faces"]).max() < corners.shape[1]


CLICKS = """
const html = require("fs").readFileSync(process.argv[1], "utf8");
const own = [...html.matchAll(/<script>([\\s\\S]*?)<\\/script>/g)].pop()[1];
const nodes = {}; let click;
const node = id => nodes[id] ??= {kids: [], append(x) { this.kids.push(x); }, on(e, f) { click = f; }};
global.document = {getElementById: node, createElement: () => ({})};
global.Plotly = {newPlot: () => {}};
new Function(own)();
const told = [nodes.said.textContent];
nodes.best.kids[1].onclick();
told.push(nodes.lines.textContent);
click({points: [{x: 0, y: 0, z: 23}]});
told.push(nodes.lines.textContent);
console.log(JSON.stringify(told));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="no Node to run the page's script")
def test_a_click_on_the_page_gives_the_nearest_places_lines(found: openings.Survey, tmp_path: Path) -> None:
    page.write_page(found, tmp_path / "openings.html")
    words = ["node", "-e", CLICKS, str(tmp_path / "openings.html")]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    first, second, clicked = json.loads(done.stdout)
    assert first.startswith("Opening 1: ")
    sites = [site for site in (*found.chosen, *found.others) if not site.fault]
    near = min(sites, key=lambda site: float(np.linalg.norm(np.round(site.point, 2) - [0, 0, 23])))
    for text, site in ((second, found.chosen[1]), (clicked, near)):
        point = YAML(typ="safe").load(text)["anatomy"]["craniotomy"]["point"]
        assert point == pytest.approx(site.point.tolist(), abs=0.006)


def test_the_picture_shows_every_opening_from_somewhere(found: openings.Survey) -> None:
    drawn = picture.draw_openings(found)
    assert drawn.ndim == 3
    assert drawn.shape[2] == 3
    blue = (drawn[..., 2] > 120) & (drawn[..., 0] < 80)
    assert blue.sum() > 300, "rings and numbers"


def test_a_fine_surface_is_thinned_and_keeps_its_shape() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5)
    vertices, faces = picture.thinned(50 * np.asarray(ball.vertices), np.asarray(ball.faces), 3000)
    assert 1000 < len(faces) <= 3000
    assert np.linalg.norm(vertices, axis=1) == pytest.approx(np.full(len(vertices), 50.0), abs=2.0)


def test_sequences_take_the_openings_of_a_brain_in_turn(egg: Path, found: openings.Survey) -> None:
    first, *others = (openings.craniotomy(site, RADIUS) for site in found.chosen)
    also = [one.model_dump(include={"point", "direction"}) for one in others]
    plain = synth.Job(sequences=6, frames=2, anatomy=Anatomy(mesh=egg, vertices=2500, craniotomy=first))
    job = synth.Job.model_validate(
        plain.model_dump()
        | {"anatomy": plain.anatomy.model_dump() | {"craniotomy": first.model_dump() | {"also": also}}}
    )
    cases = [scenario.draw(job, index) for index in range(6)]
    origins = [scene.cortex(job, case)[1].origin for case in cases]  # type: ignore[union-attr]
    for index, origin in enumerate(origins):
        assert np.linalg.norm(origin - found.chosen[index % 3].point) < 1.0
    named = [identity.identify_opening(job, case.anatomy) for case in cases]
    assert named[:3] == named[3:]
    assert len(set(named)) == 3
    assert named[0] == identity.identify_opening(plain, 0), "the same place has the same name in any dataset"
    assert identity.identify_opening(synth.Job(), 0) is None
    assert len({identity.identify_anatomy(job, 0), identity.identify_anatomy(plain, 0)}) == 1
    assert parse_job(writer.commented(job), "job", Path()) == job
    assert identity.identify_job(job) != identity.identify_job(plain)
    with pytest.raises(ValueError, match="is for a mesh"):
        Anatomy(craniotomy=Craniotomy(also=also))


def test_reading_a_brain_is_apart_from_placing_it(egg: Path) -> None:
    vertices, faces = brain_surface.read_brain(egg)
    placed = brain_surface.load_brain(egg, Craniotomy(point=(31.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0)))
    np.testing.assert_array_equal(faces, placed.faces)
    np.testing.assert_allclose(placed.vertices @ placed.turn + placed.origin, vertices, atol=1e-9)
