"""A scenario depends on (job, index) only, and grouped anatomies are really shared."""

from __future__ import annotations

import json

from synth.job.schema import Job
from synth.sequence.scenario import draw, frame_seeds


def test_same_job_and_index_draw_the_same_scenario_however_many_sequences_there_are() -> None:
    few, many = Job(seed=7, sequences=3), Job(seed=7, sequences=300)
    assert draw(few, 2) == draw(many, 2)
    assert frame_seeds(few, 2) == frame_seeds(many, 2)


def test_sequences_and_seeds_differ() -> None:
    job = Job(seed=7)
    assert draw(job, 0).gesture != draw(job, 1).gesture
    assert draw(job, 0).relief != draw(job, 1).relief
    assert draw(job, 0).gesture != draw(Job(seed=8), 0).gesture
    assert len(set(frame_seeds(job, 0) + frame_seeds(job, 1))) == 2 * job.frames


def test_variety_shares_anatomy_but_nothing_else() -> None:
    job = Job(seed=7, anatomy={"variety": 2})
    first, third = draw(job, 0), draw(job, 2)
    assert (first.anatomy, first.relief) == (third.anatomy, third.relief)
    assert first.tissue != third.tissue
    assert first.view != third.view


def test_scenario_is_json() -> None:
    case = draw(Job(seed=7), 5)
    assert json.loads(json.dumps(case.as_dict()))["index"] == 5
