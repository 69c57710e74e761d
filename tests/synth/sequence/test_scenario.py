"""A scenario depends on (job, index) only; its contacts lie in the opening and in the picture."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from synth.fem import equilibrium
from synth.job.schema import Job
from synth.render.camera import camera
from synth.sequence import randomization
from synth.sequence.draw import draw, draw_scenario, read_lens
from synth.sequence.rest_scene import at_rest
from synth.sequence.simulation import simulate


def test_same_job_and_index_draw_the_same_scenario_however_many_sequences_there_are() -> None:
    short_job, long_job = Job(seed=7, sequences=3), Job(seed=7, sequences=300)
    assert draw_scenario(short_job, 2) == draw_scenario(long_job, 2)
    assert draw(short_job, 2).frame_seeds == draw(long_job, 2).frame_seeds


def test_shares_are_drawn_and_unused_quantities_change_no_draw() -> None:
    usual_cases = [draw_scenario(Job(sequences=40), k) for k in range(40)]
    fem = {"membrane": {"probability": 0.5}, "pulse": {"heart_mm": [0.1, 0.5]}, "skull": ["bonded", "slip"]}
    cases = [
        draw_scenario(Job.model_validate({"sequences": 40, "fem": fem | {"poisson": [0.4, 0.49]}}), k)
        for k in range(40)
    ]
    assert 10 < sum(case.tissue.membrane is not None for case in cases) < 30
    assert {case.tissue.skull for case in cases} == {"bonded", "slip"}
    assert all(0.4 <= case.tissue.poisson <= 0.49 for case in cases)
    assert all(case.pulse is not None and 0.1 <= case.pulse.heart_mm <= 0.5 for case in cases)
    for case, usual_case in zip(cases, usual_cases, strict=True):
        assert usual_case.pulse is usual_case.tissue.membrane is None
        assert case.tissue.young_kpa == usual_case.tissue.young_kpa
        assert (case.gestures, case.appearance) == (usual_case.gestures, usual_case.appearance)


def test_blur_is_drawn_in_proportion_to_the_width_and_changes_no_other_draw() -> None:
    plain_job, fixed_job = (
        Job(sequences=20),
        Job.model_validate({"sequences": 20, "sensor": {"blur_px": 0.5}}),
    )
    small_job = Job.model_validate({"sequences": 20, "render": {"size": [320, 240]}})
    appearances = [draw_scenario(plain_job, k).appearance for k in range(20)]
    blur = np.array([appearance.sensor.blur for appearance in appearances])
    assert 0.4 <= blur.min() < 0.6
    assert 1.0 < blur.max() <= 1.2
    for k, appearance in enumerate(appearances):
        assert draw_scenario(small_job, k).appearance.sensor.blur == appearance.sensor.blur / 2
        assert draw_scenario(fixed_job, k).appearance == replace(
            appearance, sensor=replace(appearance.sensor, blur=0.5)
        )


@pytest.mark.parametrize("size", [(640, 480), (640, 360)])
def test_contacts_keep_to_what_the_camera_shows_of_a_wide_opening(size: tuple[int, int]) -> None:
    anatomy, fem = {"craniotomy": {"radius_mm": 24}}, {"footprint_mm": [2, 3]}
    render = {"size": size, "tilt_deg": [15, 25]}
    job = Job.model_validate({"sequences": 40, "anatomy": anatomy, "fem": fem, "render": render})
    turn = np.linspace(0, 2 * np.pi, 100)
    reach = []
    for case in (draw_scenario(job, k) for k in range(job.sequences)):
        lens, reach_mm = camera.place(case.view, read_lens(job.render)), case.gestures[0].reach_mm
        circle = reach_mm * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
        pixels = camera.project(lens, circle)
        assert (pixels > -0.6).all()
        assert (pixels < np.array(size) - 0.4).all()
        reach.append(reach_mm / camera.visible_radius(lens))
    assert max(reach) > 0.9, "up to the picture's edge"


@pytest.fixture
def brittle_job(monkeypatch: pytest.MonkeyPatch) -> Job:
    """A small job, and a limit of det F that one in a few of its sequences falls below."""
    monkeypatch.setattr(equilibrium, "LEAST_JACOBIAN", 0.9)
    return Job.model_validate(
        {"sequences": 20, "frames": 5, "anatomy": {"vertices": 2500}, "fem": {"tets": 300}}
    )


@pytest.mark.slow
def test_a_load_that_the_mesh_does_not_bear_is_drawn_anew_alike_each_time(brittle_job: Job) -> None:
    cases = [simulate(brittle_job, index).scenario for index in range(4)]
    assert 0 < sum(case.attempt > 0 for case in cases) < 4
    for case in cases:
        first_case = draw_scenario(brittle_job, case.index)
        assert (case.gestures == first_case.gestures) is (case.attempt == 0)
        assert replace(case, gestures=first_case.gestures, attempt=0) == first_case
        assert case == draw_scenario(brittle_job, case.index, case.attempt)


def test_a_stated_load_that_the_mesh_does_not_bear_is_refused(brittle_job: Job) -> None:
    instrument = {"gesture": "push", "load": 0.4, "place": [0, 0]}
    fem = brittle_job.fem.model_validate({"tets": 300, "instrument_list": [instrument]})
    with pytest.raises(equilibrium.InvertedElement, match=r"load 0\.4"):
        simulate(brittle_job.model_copy(update={"fem": fem}))


def test_a_scene_is_drawn_and_placed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = {name: 0 for name in ("randomize", "place")}
    for module, name in ((randomization, "randomize"), (camera, "place")):
        original = getattr(module, name)

        def count_call(*args: object, name: str = name, original: Any = original) -> Any:
            calls[name] += 1
            return original(*args)

        monkeypatch.setattr(module, name, count_call)
    groups = {"field": 1, "camera": 1, "surroundings": 1}
    rest = at_rest(Job.model_validate({"anatomy": {"vertices": 900}, "randomize": groups}), 3)
    assert calls == {"randomize": 1, "place": 1}
    assert rest.draw.camera is rest.view
