"""Instruments as asked: where, what, how hard and when; the rest drawn, all of them named."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

import synth
from synth.fem import tool_gesture
from synth.sequence import scenario

PUSH = {
    "gesture": "push",
    "place": [4.0, 0.0],
    "direction": [0.0, 0.6, -0.8],
    "load": 0.1,
    "footprint_mm": 3.5,
    "timing": [0.1, 0.3, 0.6, 0.9],
}
PULL = {"gesture": "pull", "place": [-5.0, 1.0], "force_mn": 1.5, "direction": [0, 0, 2]}


def job(*crew: dict[str, Any], **fem: Any) -> synth.Job:
    return synth.Job.model_validate({"seed": 3, "sequences": 20, "fem": {"instrument_list": crew, **fem}})


def test_what_is_asked_is_done_and_the_rest_is_drawn() -> None:
    asked = job(PUSH, PULL)
    cases = [scenario.draw_scenario(asked, index) for index in range(20)]
    for case in cases:
        push, pull = case.gestures
        assert (push.kind, push.point_mm, push.load, push.footprint_mm) == ("push", (4.0, 0.0), 0.1, 3.5)
        assert push.direction == pytest.approx((0.0, 0.6, -0.8))
        assert push.timing == (0.1, 0.3, 0.6, 0.9)
        assert push.force_mn == pytest.approx(0.1 * case.tissue.young_kpa * 3.5**2)
        assert (pull.kind, pull.point_mm, pull.direction) == ("pull", (-5.0, 1.0), pytest.approx((0, 0, 1)))
        assert pull.force_mn == pytest.approx(1.5)
        assert 3 <= pull.footprint_mm <= 6
        assert tool_gesture.clearance(push, pull) >= 0
    for drawn in ("azimuth_deg", "hover_mm"):
        assert len({getattr(case.gesture, drawn) for case in cases}) == 20
    assert len({case.further[0].timing for case in cases}) == 20


@pytest.mark.parametrize(
    "wrong",
    [
        {"place": [11, 0]},
        {"gesture": "slide", "direction": [0, 0, -1]},
        {"load": 0.1, "force_mn": 1},
    ],
)
def test_what_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="instrument_list"):
        job(wrong)
