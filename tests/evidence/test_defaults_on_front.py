"""Defaults stay on the fronts that were measured, and every page of results is sufficient to itself."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from evidence import defaults_on_front as fronts
from evidence.defaults_on_front import Front, Point
from learn.loss import Objective
from learn.settings import PRESETS, preset
from synth.errors import UserError

RESULTS = Path(__file__).parents[2] / "docs" / "results"
GATHERED = fronts.gather(RESULTS)


@pytest.mark.parametrize("front", GATHERED, ids=[front.room for front in GATHERED])
def test_a_default_is_on_its_front(front: Front) -> None:
    """The code's default, looked up by what it is, among the points of the committed data."""
    assert front.holds()


def test_every_room_has_a_front() -> None:
    rooms = {front.room.split(",")[0] for front in GATHERED}
    assert rooms == {"fem", "render", "flow", "learn", "end to end"}


def test_every_preset_of_learn_but_the_published_one_has_a_front() -> None:
    """Those of two eyes are `cpu` and `live` with another input; nothing of theirs was varied yet."""
    fronts = {front.room: front for front in GATHERED if front.room.startswith("learn")}
    one_eye = {name for name, settings in PRESETS.items() if not settings.arch.depth}
    assert set(fronts) == {f"learn, {name}" for name in one_eye - {"paper"}}
    assert all(len(front.points) > 2 for front in fronts.values())


def test_a_preset_whose_loss_changed_has_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was measured with another loss doesn't stand for it."""
    changed = preset("cpu", objective=Objective(kind="mae"))
    monkeypatch.setitem(PRESETS, "cpu", changed)
    with pytest.raises(UserError, match="not among"):
        next(front for front in fronts.gather(RESULTS) if front.room == "learn, cpu").find()


def made(*points: tuple[str, float, float]) -> Front:
    return Front("room", "s", "%", tuple(Point((n,), n, cost, error) for n, cost, error in points), ("us",))


def test_how_far_off_the_front() -> None:
    assert made(("us", 1.0, 2.0), ("dear", 2.0, 1.0), ("cheap", 0.5, 4.0)).excess() == 0
    assert made(("us", 1.0, 2.0), ("better", 0.9, 1.0)).excess() == pytest.approx(1 / 0.9 - 1)
    assert made(("us", 1.0, 2.0), ("better", 0.5, 1.98)).excess() == pytest.approx(2 / 1.98 - 1)


def test_a_default_that_nobody_measured_is_found_out() -> None:
    front = replace(made(("them", 1.0, 2.0)), default=("us",))
    with pytest.raises(UserError, match="not among"):
        front.excess()


def test_beaten_only_beyond_doubt() -> None:
    us = Point(("us",), "us", 1.0, 2.0, (1.5, 2.5))
    near = Point(("near",), "near", 0.9, 1.6, (1.2, 1.9))
    far = Point(("far",), "far", 0.9, 1.0, (0.8, 1.4))
    assert Front("room", "s", "%", (us, near), ("us",)).beaten_by() is None
    assert Front("room", "s", "%", (us, near, far), ("us",)).beaten_by() == far


@pytest.mark.parametrize("page", sorted(RESULTS.rglob("*.html")), ids=lambda p: str(p.relative_to(RESULTS)))
def test_a_page_of_results_loads_nothing(page: Path) -> None:
    text = page.read_text("utf-8")
    assert not re.findall(r"""(?:src|href)\s*=\s*["']?\s*(?:https?:)?//|@import|url\(\s*["']?http""", text)
