"""The interval part of a split: no brain is on two sides."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from learn.checkpoint import ModelCard
from learn.data.clips import Clip
from learn.data.grid import Scales
from learn.settings import preset
from learn.split import Split, find_obstacle, find_sides, keep_back, name_parts


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


def test_half_of_the_validation_brains_are_moved_to_the_interval_part(clips: list[Clip]) -> None:
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


def test_brains_in_the_card_or_in_a_test_are_not_used_for_intervals(clips: list[Clip]) -> None:
    some = many(clips, 30)
    named = name_parts(some, Split(of(range(6)), of(range(6, 10)), of([10, 11])))
    known = ModelCard(preset("tiny"), Scales(1.0, 0.2, 1.0, 100.0, 0.3), 1.7, *named)
    # A sequence of its own of a brain that was fitted, of one that is test, and a brain marked test.
    some += [
        dataclasses.replace(some[0], content_hash="new-a", group="brain-3"),
        dataclasses.replace(some[0], content_hash="new-b", group="brain-10"),
    ]
    found = find_sides(some, known, {"12-0"}, from_test=False)
    assert {some[i].group for i in found.intervals} == {f"brain-{b}" for b in range(13, 30)}
    assert {some[i].group for i in found.test} == {"brain-10", "brain-11", "brain-12"}
    assert {some[i].group for i in found.fit} == {f"brain-{b}" for b in range(6)}
