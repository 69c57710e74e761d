"""A scenario depends on (job, index) only; its contacts lie in the opening and in the picture."""

import numpy as np
import pytest

from synth.job.schema import Job
from synth.render.camera import camera
from synth.sequence.scenario import draw_scenario, frame_seeds


def test_same_job_and_index_draw_the_same_scenario_however_many_sequences_there_are() -> None:
    few, many = Job(seed=7, sequences=3), Job(seed=7, sequences=300)
    assert draw_scenario(few, 2) == draw_scenario(many, 2)
    assert frame_seeds(few, 2) == frame_seeds(many, 2)


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


@pytest.mark.parametrize("size", [(640, 480), (640, 360)])
def test_contacts_keep_to_what_the_camera_shows_of_a_wide_opening(size: tuple[int, int]) -> None:
    opening, narrow = {"craniotomy": {"radius_mm": 24}}, {"footprint_mm": [2, 3]}
    render = {"size": size, "tilt_deg": [15, 25]}
    wide = Job.model_validate({"sequences": 40, "anatomy": opening, "fem": narrow, "render": render})
    turn = np.linspace(0, 2 * np.pi, 100)
    reach = []
    for case in (draw_scenario(wide, k) for k in range(wide.sequences)):
        lens, reach_mm = camera.place(case.view, wide.render), case.gestures[0].reach_mm
        circle = reach_mm * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
        pixels = camera.project(lens, circle)
        assert (pixels > -0.6).all()
        assert (pixels < np.array(size) - 0.4).all()
        reach.append(reach_mm / camera.visible_radius(lens))
    assert max(reach) > 0.9, "up to the picture's edge"
