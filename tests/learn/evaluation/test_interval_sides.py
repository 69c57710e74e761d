"""Who intervals are fitted on, and that no brain is on two sides."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import pytest

from learn.checkpoint import Card
from learn.data.clips import Clip
from learn.data.grid import Scales
from learn.data.split import Split
from learn.evaluation.evaluate import unseen
from learn.evaluation.interval_sides import find_obstacle, find_sides, keep_back
from learn.settings import preset


def many(clips: list[Clip], brains: int, each: int = 2) -> list[Clip]:
    """Sequences that differ in name alone."""
    one = clips[0]
    return [
        dataclasses.replace(one, content_hash=f"{b}-{k}", group=f"brain-{b}")
        for b in range(brains)
        for k in range(each)
    ]


def of(brains: Iterable[int], each: int = 2) -> tuple[int, ...]:
    return tuple(b * each + k for b in brains for k in range(each))


def card(clips: list[Clip], **parts: tuple[int, ...]) -> Card:
    hashes = {part: [clips[i].content_hash for i in which] for part, which in parts.items()}
    groups = {part: sorted({clips[i].group for i in which}) for part, which in parts.items()}
    return Card(preset("tiny"), Scales(1.0, 0.2, 1.0, 100.0, 0.3), 1.7, hashes, groups)


def test_half_of_the_choosing_brains_are_kept_whole(clips: list[Clip]) -> None:
    some = many(clips, 40)
    first = Split(of(range(10)), of(range(10, 30)), of(range(30, 40)))
    found = keep_back(some, first, seed=0)
    assert len({some[i].group for i in found.intervals}) == 10
    assert sorted((*found.select, *found.intervals)) == sorted(first.select)
    assert not {some[i].group for i in found.select} & {some[i].group for i in found.intervals}
    assert (found.fit, found.test) == (first.fit, first.test)
    assert keep_back(some, first, seed=0) == found
    assert keep_back(some, first, seed=1) != found
    assert find_obstacle([some[i] for i in found.select], [some[i] for i in found.intervals]) == ""


def test_too_few_are_left_to_choose_and_the_reason_is_said(clips: list[Clip]) -> None:
    some = many(clips, 30)
    first = Split(of(range(6)), of(range(6, 23)), of(range(23, 30)))
    assert keep_back(some, first, seed=0) == first
    said = find_obstacle([some[i] for i in first.select], [])
    assert said == "0 brains are kept for intervals; 90% intervals need 9"
    assert "left to choose the epoch" in find_obstacle(some[:4], some[4:])


def test_what_a_model_has_met_and_its_test_are_not_taken(clips: list[Clip]) -> None:
    some = many(clips, 30)
    known = card(some, fit=of(range(6)), select=of(range(6, 10)), test=of([10, 11]))
    # A sequence of its own of a brain that was fitted, of one that is test, and a brain marked test.
    some += [
        dataclasses.replace(some[0], content_hash="new-a", group="brain-3"),
        dataclasses.replace(some[0], content_hash="new-b", group="brain-10"),
    ]
    found = find_sides(some, known, {"12-0"}, from_test=False)
    assert {some[i].group for i in found.intervals} == {f"brain-{b}" for b in range(13, 30)}
    assert {some[i].group for i in found.test} == {"brain-10", "brain-11", "brain-12"}
    assert {some[i].group for i in found.fit} == {f"brain-{b}" for b in range(6)}


def test_half_of_the_test_is_taken_when_that_is_asked_for(clips: list[Clip]) -> None:
    some = many(clips, 30)
    known = card(some, fit=of(range(4)), select=of(range(4, 8)), test=of(range(8, 30)))
    found = find_sides(some, known, (), from_test=True)
    assert len(found.intervals) == len(found.test) == 22
    assert not {some[i].group for i in found.intervals} & {some[i].group for i in found.test}


def test_what_was_kept_stays_kept_and_is_not_scored(clips: list[Clip]) -> None:
    some = many(clips, 30)
    known = card(some, fit=of(range(4)), select=of(range(4, 8)), intervals=of(range(8, 17)))
    found = find_sides(some, known, (), from_test=False)
    assert found.intervals == of(range(8, 17))
    assert {c.group for c in unseen(some, known)} == {f"brain-{b}" for b in range(17, 30)}


@pytest.mark.parametrize("from_test", [True, False])
def test_nothing_new_is_nothing_kept(clips: list[Clip], from_test: bool) -> None:
    some = many(clips, 8)
    known = card(some, fit=of(range(4)), select=of(range(4, 8)))
    assert find_sides(some, known, (), from_test).intervals == ()


def test_a_further_sequence_of_a_brain_that_chose_or_was_fitted_is_never_kept(clips: list[Clip]) -> None:
    some = many(clips, 30)
    known = card(some, fit=of(range(4)), select=of([4, 5, 6]), intervals=of([4, *range(8, 20)]))
    found = find_sides(some, known, (), from_test=False)
    assert {some[i].group for i in found.intervals} == {f"brain-{b}" for b in range(8, 20)}


def test_brains_never_met_lend_the_scale_what_choosing_left_it_short_of(clips: list[Clip]) -> None:
    some = many(clips, 30)
    known = card(some, fit=of(range(4)), select=of([4]))
    found = find_sides(some, known, (), from_test=False)
    brains = [{some[i].group for i in part} for part in (found.select, found.intervals)]
    assert [len(one) for one in brains] == [3, 23]
    assert "brain-4" in brains[0]
    assert not brains[0] & brains[1]
    assert find_obstacle([some[i] for i in found.select], [some[i] for i in found.intervals]) == ""
    # Ten that it never met are one too few for both: nothing is moved, and the reason is said.
    few = some[: 2 * 15]
    left = find_sides(few, known, (), from_test=False)
    assert (left.select, left.intervals) == (of([4]), of(range(5, 15)))
    assert find_obstacle([few[i] for i in left.select], [few[i] for i in left.intervals]).startswith(
        "1 brain"
    )
