"""The time left is said by the latest sequences: the first of every worker compile as well."""

from __future__ import annotations

import pytest

from synth.engine.eta import Pace


def told(workers: int, *ends: float) -> Pace:
    pace = Pace(workers)
    for at in ends:
        pace.end(at)
    return pace


def test_nothing_is_said_before_a_sequence_has_ended() -> None:
    assert told(2).left_s(5) is None


def test_first_sequences_count_while_there_are_no_others() -> None:
    pace = told(2, 20.0, 21.0)
    assert pace.cold
    assert pace.left_s(10) == pytest.approx(10 * 21 / 2)


def test_first_sequences_are_left_out_afterwards() -> None:
    pace = told(2, 20.0, 21.0, 25.0, 26.0)
    assert not pace.cold
    assert pace.left_s(10) == pytest.approx(10 * 2.5)
    assert told(1, 20.0, 25.0).left_s(4) == pytest.approx(20)


def test_a_long_run_goes_by_its_latest_sequences() -> None:
    slow, fast = [10.0 * k for k in range(1, 101)], [1000.0 + 2.0 * k for k in range(1, 101)]
    assert told(1, *slow, *fast).left_s(50) == pytest.approx(100)
