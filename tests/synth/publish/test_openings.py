"""Suggested openings of a brain: their places and directions, and the job made of them."""

from pathlib import Path

import numpy as np
import pytest
from command import run
from egg_brain import soup, write_triangles

import synth
from synth.cli import app
from synth.job import identity, job_writer
from synth.job.reader import parse_job
from synth.publish import openings
from synth.publish.openings import Opening
from synth.sequence.fem_mechanics import build_volume
from synth.sequence.rest_scene import at_rest

pytestmark = pytest.mark.slow

RADIUS = 8.0


@pytest.fixture(scope="module")
def egg(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_triangles(tmp_path_factory.mktemp("place") / "egg.stl", soup())


@pytest.fixture(scope="module")
def brain_openings(egg: Path) -> list[Opening]:
    return openings.find_openings(egg, RADIUS, 3)


def test_openings_of_an_egg_are_on_it_along_its_normal_and_apart(brain_openings: list[Opening]) -> None:
    assert len(brain_openings) == 3
    for opening in brain_openings:
        ellipsoid_level = (opening.point / [32.0, 26.0, 22.0]) @ (opening.point / [32.0, 26.0, 22.0])
        assert ellipsoid_level == pytest.approx(1.0, abs=0.06), "it is on the surface"
        normal = opening.point / np.square([32.0, 26.0, 22.0])
        assert opening.direction @ normal / np.linalg.norm(normal) > np.cos(np.radians(6))
        assert opening.relief_mm < 0.4
    for k, opening in enumerate(brain_openings):
        for other in brain_openings[:k]:
            assert np.linalg.norm(opening.point - other.point) >= 2 * RADIUS, "no common tissue"


def test_the_command_draws_the_places_and_prints_a_valid_job(egg: Path, tmp_path: Path) -> None:
    result = run(app, "preview", egg, "--radius", RADIUS, "--count", 2, "-o", tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000
    (tmp_path / "job.yaml").write_text(result.stdout)
    job = synth.load_job(str(tmp_path / "job.yaml"), ["anatomy.vertices=2500", "fem.tets=400"])
    assert job.anatomy.mesh == egg
    build_volume(at_rest(job))
    (tmp_path / "job.yaml").write_text(result.stdout.replace("    # ", "    "))
    craniotomy = synth.load_job(str(tmp_path / "job.yaml")).anatomy.craniotomy
    assert len(craniotomy.also) == 1
    assert craniotomy.also[0].point != craniotomy.point


def test_sequences_use_the_openings_of_a_brain_in_turn(egg: Path, brain_openings: list[Opening]) -> None:
    first, *others = (opening.craniotomy(RADIUS).model_dump() for opening in brain_openings)
    other_openings = [{name: craniotomy[name] for name in ("point", "direction")} for craniotomy in others]
    anatomy = {"mesh": egg, "vertices": 2500, "craniotomy": first | {"also": other_openings}}
    job = synth.Job.model_validate({"sequences": 6, "frames": 3, "anatomy": anatomy})
    for index in range(6):
        brain = at_rest(job, index).brain
        assert brain is not None
        assert np.linalg.norm(brain.to_world @ [*brain_openings[index % 3].point, 1.0] - [0, 0, 0, 1]) < 1.0
    identities = [
        identity.identify_opening(job, index, identity.identify_anatomy(job, 0)) for index in range(6)
    ]
    assert identities[:3] == identities[3:]
    assert len(set(identities)) == 3
    assert parse_job(job_writer.document_job(job), "job", Path()) == job
