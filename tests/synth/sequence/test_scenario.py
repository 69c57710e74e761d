"""A scenario depends on (job, index) only, and grouped anatomies are really shared."""

from __future__ import annotations

from synth.job.schema import Job
from synth.sequence.scenario import draw_scenario, frame_seeds


def test_same_job_and_index_draw_the_same_scenario_however_many_sequences_there_are() -> None:
    few, many = Job(seed=7, sequences=3), Job(seed=7, sequences=300)
    assert draw_scenario(few, 2) == draw_scenario(many, 2)
    assert frame_seeds(few, 2) == frame_seeds(many, 2)


def test_shares_are_drawn_and_what_is_not_asked_for_changes_no_draw() -> None:
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
        assert (one.gesture, one.look) == (usual.gesture, usual.look)
