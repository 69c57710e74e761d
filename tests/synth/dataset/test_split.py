"""Splits: no group is on two sides, held-out families are never in training, order has no effect."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from synth.dataset import sequence_split
from synth.dataset.sequence_split import DatasetSplit
from synth.errors import UserError


def rows(count: int = 60, anatomies: int = 20) -> list[dict[str, Any]]:
    return [
        {
            "index": k,
            "status": "done" if k != 7 else "failed",
            "anatomy": k % anatomies,
            "family": ("healthy", "pale", "calf")[k % anatomies % 3],
            "content_hash": str(k),
        }
        for k in range(count)
    ]


def sides(found: list[dict[str, Any]], rule: DatasetSplit) -> dict[int, str | None]:
    return {
        row["index"]: side for row, side in zip(found, sequence_split.assign_sides(found, rule), strict=True)
    }


def test_shares_are_met_in_any_order_and_held_out_families_are_for_testing_only() -> None:
    found = rows()
    given = sides(found, DatasetSplit())
    assert given == sides(found[::-1], DatasetSplit())
    assert given[7] is None
    counts = sequence_split.count([{"split": side} for side in given.values()])
    for side, share in zip(sequence_split.SIDES, (0.7, 0.15, 0.15), strict=True):
        assert abs(counts[side] - 59 * share) <= 3, "an anatomy has three sequences"
    given = sides(found, DatasetSplit(held_out=("pale",)))
    pale = {given[row["index"]] for row in found if row["family"] == "pale" and row["status"] == "done"}
    assert pale == {"test"}
    assert {"train", "validation", "test"} <= set(given.values())


@pytest.mark.parametrize(
    "wrong", [{"shares": (0.5, 0.1, 0.1)}, {"shares": (float("nan"), 0.5, 0.5)}, {"held_out": ("blue",)}]
)
def test_a_split_that_is_not_possible_is_refused(wrong: dict[str, Any]) -> None:
    rule = DatasetSplit(**wrong)
    with pytest.raises(UserError):
        sequence_split.assign_sides(rows(anatomies=60), rule)


def test_a_dataset_of_one_brain_is_split_within_it_only_on_request() -> None:
    found = [{**row, "anatomy": "mesh-1"} for row in rows()]
    with pytest.raises(UserError, match=r"--share-anatomy"):
        sequence_split.assign_sides(found, DatasetSplit("sequence"))
    rule = DatasetSplit("sequence", share_anatomy=True)
    given = [
        {**row, "split": side}
        for row, side in zip(found, sequence_split.assign_sides(found, rule), strict=True)
    ]
    assert set(sequence_split.count(given)) == set(sequence_split.SIDES)
    assert not sequence_split.leaks(given, rule)
    assert sequence_split.leaks(given)[0].startswith("anatomy mesh-1 is in")


def test_openings_of_one_brain_are_on_separate_sides() -> None:
    brain = [{**row, "anatomy": "mesh-1", "opening": f"mesh-1 at {row['index'] % 5}"} for row in rows()]
    # Procedural brains, which have no opening of their own, stay whole.
    found = [*brain, *({**row, "index": 60 + row["index"], "opening": None} for row in rows())]
    rule = sequence_split.parse_rule("opening", "0.6,0.2,0.2", [])
    given = [
        {**row, "split": side}
        for row, side in zip(found, sequence_split.assign_sides(found, rule), strict=True)
    ]
    on: dict[str, set[str]] = {}
    for row in given:
        if row["status"] == "done":
            on.setdefault(row["opening"] or row["anatomy"], set()).add(row["split"])
    assert len(on) == 25
    assert all(len(sides) == 1 for sides in on.values())
    assert {next(iter(on[f"mesh-1 at {k}"])) for k in range(5)} == set(sequence_split.SIDES)
    # The procedural rows have the same content hashes as the brain's, which is a leak.
    assert not [line for line in sequence_split.leaks(given, rule) if not line.startswith("content_hash")]


def test_groups_are_joined_by_any_key_and_through_others() -> None:
    anatomies, hashes = "abcadef", "1234562"
    # a: 0 and 3; the hash 2: 1 and 6; all others alone.
    assert sequence_split.join_groups(anatomies, hashes) == [0, 1, 2, 0, 4, 5, 1]
    # 5 and 0 by the third key, and so 3.
    assert sequence_split.join_groups(anatomies, hashes, "xyzuvxw") == [0, 1, 2, 0, 4, 0, 1]
    assert sequence_split.find_crossings([0, 1, 0, 1], ["fit", "test", "test", "test"]) == {
        0: ["fit", "test"]
    }


@pytest.mark.parametrize("by", ["anatomy", "sequence"])
def test_new_sequences_move_no_others_and_leak_nothing(by: str) -> None:
    """For any order of arrival; shares are met as closely as when all groups are assigned at once."""
    for draw in range(30):
        rng = np.random.default_rng([35, draw])
        found = rows(int(rng.integers(20, 120)), int(rng.integers(6, 60)))
        order = rng.permutation(len(found)).tolist()
        rule = DatasetSplit(by, share_anatomy=draw % 3 == 2, held_out=("calf",) * (draw % 5 == 4))  # type: ignore[arg-type]
        there = list[dict[str, Any]]()
        for part in np.array_split(order, 4):
            there += [found[k] for k in part]
            sides = sequence_split.assign_if_possible(there, rule)
            given = {row["content_hash"]: side for row, side in zip(there, sides, strict=True) if side}
            assert rule.sides.items() <= given.items()
            rule = replace(rule, sides=given)
            assert not sequence_split.leaks(
                [{**row, "split": given.get(row["content_hash"])} for row in there], rule
            )
            for value in {row["anatomy"] for row in there} if by == "anatomy" else ():
                some = {given.get(row["content_hash"]) for row in there if row[by] == value} - {None}
                assert rule.share_anatomy or len(some) <= 1
        if by == "anatomy" and not rule.held_out and not rule.share_anatomy and given:
            counts = [list(given.values()).count(side) for side in sequence_split.SIDES]
            largest = max(sum(row["anatomy"] == one["anatomy"] for row in found) for one in found)
            for count, share in zip(counts, (0.7, 0.15, 0.15), strict=True):
                assert abs(count - share * len(given)) <= max(2 * largest, 3)


def test_openings_that_share_tissue_are_never_on_two_sides_in_any_order() -> None:
    for draw in range(40):
        rng = np.random.default_rng([36, draw])
        at = rng.uniform(-60, 60, (int(rng.integers(8, 40)), 3)).round(2)
        brain = rng.integers(0, 2, len(at)).tolist()
        names = [f"mesh-{b} at {x}, {y}, {z}" for b, (x, y, z) in zip(brain, at.tolist(), strict=True)]
        found = [
            {**rows(1)[0], "index": k, "content_hash": str(k), "anatomy": f"mesh-{brain[k]}", "opening": name}
            for k, name in enumerate(names)
        ]
        rule = sequence_split.parse_rule("opening", "0.6,0.2,0.2", [], apart_mm=24.0)
        for part in (len(found) // 2, len(found)):
            there = found[:part]
            sides = sequence_split.assign_if_possible(there, rule)
            on = {row["index"]: side for row, side in zip(there, sides, strict=True) if side}
            given = {row["content_hash"]: on[row["index"]] for row in there if row["index"] in on}
            rule = replace(rule, sides=given)  # type: ignore[arg-type]
            for a in on:
                near = [b for b in on if brain[a] == brain[b] and np.linalg.norm(at[a] - at[b]) < 24.0]
                assert {on[b] for b in near} == {on[a]}
