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
    few, many = Job(seed=7, sequences=3), Job(seed=7, sequences=300)
    assert draw_scenario(few, 2) == draw_scenario(many, 2)
    assert draw(few, 2).frame_seeds == draw(many, 2).frame_seeds


def test_shares_are_drawn_and_unused_quantities_change_no_draw() -> None:
    plain = [draw_scenario(Job(sequences=40), k) for k in range(40)]
    fem = {"membrane": {"probability": 0.5}, "pulse": {"heart_mm": [0.1, 0.5]}, "skull": ["bonded", "slip"]}
    drawn = [
        draw_scenario(Job.model_validate({"sequences": 40, "fem": fem | {"poisson": [0.4, 0.49]}}), k)
        for k in range(40)
    ]
    assert 10 < sum(one.tissue.membrane is not None for one in drawn) < 30
    assert {one.tissue.skull for one in drawn} == {"bonded", "slip"}
    assert all(0.4 <= one.tissue.poisson <= 0.49 for one in drawn)
    assert all(one.pulse is not None and 0.1 <= one.pulse.heart_mm <= 0.5 for one in drawn)
    for one, usual in zip(drawn, plain, strict=True):
        assert usual.pulse is usual.tissue.membrane is None
        assert one.tissue.young_kpa == usual.tissue.young_kpa
        assert (one.gestures, one.appearance) == (usual.gestures, usual.appearance)


def test_blur_is_drawn_in_proportion_to_the_width_and_changes_no_other_draw() -> None:
    plain, still = Job(sequences=20), Job.model_validate({"sequences": 20, "sensor": {"blur_px": 0.5}})
    small = Job.model_validate({"sequences": 20, "render": {"size": [320, 240]}})
    drawn = [draw_scenario(plain, k).appearance for k in range(20)]
    blur = np.array([one.sensor.blur for one in drawn])
    assert 0.4 <= blur.min() < 0.6
    assert 1.0 < blur.max() <= 1.2
    for k, one in enumerate(drawn):
        assert draw_scenario(small, k).appearance.sensor.blur == one.sensor.blur / 2
        assert draw_scenario(still, k).appearance == replace(one, sensor=replace(one.sensor, blur=0.5))


@pytest.mark.parametrize("size", [(640, 480), (640, 360)])
def test_contacts_keep_to_what_the_camera_shows_of_a_wide_opening(size: tuple[int, int]) -> None:
    opening, narrow = {"craniotomy": {"radius_mm": 24}}, {"footprint_mm": [2, 3]}
    render = {"size": size, "tilt_deg": [15, 25]}
    wide = Job.model_validate({"sequences": 40, "anatomy": opening, "fem": narrow, "render": render})
    turn = np.linspace(0, 2 * np.pi, 100)
    reach = []
    for case in (draw_scenario(wide, k) for k in range(wide.sequences)):
        lens, reach_mm = camera.place(case.view, read_lens(wide.render)), case.gestures[0].reach_mm
        circle = reach_mm * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
        pixels = camera.project(lens, circle)
        assert (pixels > -0.6).all()
        assert (pixels < np.array(size) - 0.4).all()
        reach.append(reach_mm / camera.visible_radius(lens))
    assert max(reach) > 0.9, "up to the picture's edge"


@pytest.fixture
def brittle(monkeypatch: pytest.MonkeyPatch) -> Job:
    """A small job, and a limit of det F that one in a few of its sequences falls below."""
    monkeypatch.setattr(equilibrium, "LEAST_JACOBIAN", 0.9)
    return Job.model_validate(
        {"sequences": 20, "frames": 5, "anatomy": {"vertices": 2500}, "fem": {"tets": 300}}
    )


@pytest.mark.slow
def test_a_load_that_the_mesh_does_not_bear_is_drawn_anew_alike_each_time(brittle: Job) -> None:
    cases = [simulate(brittle, index).scenario for index in range(4)]
    assert 0 < sum(case.attempt > 0 for case in cases) < 4
    for case in cases:
        first = draw_scenario(brittle, case.index)
        assert (case.gestures == first.gestures) is (case.attempt == 0)
        assert replace(case, gestures=first.gestures, attempt=0) == first
        assert case == draw_scenario(brittle, case.index, case.attempt)


def test_a_stated_load_that_the_mesh_does_not_bear_is_refused(brittle: Job) -> None:
    given = {"gesture": "push", "load": 0.4, "place": [0, 0]}
    fem = brittle.fem.model_validate({"tets": 300, "instrument_list": [given]})
    with pytest.raises(equilibrium.InvertedElement, match=r"load 0\.4"):
        simulate(brittle.model_copy(update={"fem": fem}))


def test_a_scene_is_drawn_and_placed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = {name: 0 for name in ("randomize", "place")}
    for module, name in ((randomization, "randomize"), (camera, "place")):
        original = getattr(module, name)

        def counted(*args: object, name: str = name, original: Any = original) -> Any:
            calls[name] += 1
            return original(*args)

        monkeypatch.setattr(module, name, counted)
    groups = {"field": 1, "camera": 1, "surroundings": 1}
    rest = at_rest(Job.model_validate({"anatomy": {"vertices": 900}, "randomize": groups}), 3)
    assert calls == {"randomize": 1, "place": 1}
    assert rest.draw.camera is rest.view
