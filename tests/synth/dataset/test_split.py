"""Splits: no group is on two sides, held-out families are never in training, order has no effect."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from synth.dataset import sequence_split
from synth.dataset.sequence_split import DatasetSplit
from synth.errors import UserError


def make_rows(count: int = 60, anatomies: int = 20) -> list[dict[str, Any]]:
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


def map_sides(rows: list[dict[str, Any]], rule: DatasetSplit) -> dict[int, str | None]:
    return {
        row["index"]: side for row, side in zip(rows, sequence_split.assign_sides(rows, rule), strict=True)
    }


def test_shares_are_met_in_any_order_and_held_out_families_are_for_testing_only() -> None:
    rows = make_rows()
    sides = map_sides(rows, DatasetSplit())
    assert sides == map_sides(rows[::-1], DatasetSplit())
    assert sides[7] is None
    counts = sequence_split.count([{"split": side} for side in sides.values()])
    for side, share in zip(sequence_split.SIDES, (0.7, 0.15, 0.15), strict=True):
        assert abs(counts[side] - 59 * share) <= 3, "an anatomy has three sequences"
    sides = map_sides(rows, DatasetSplit(held_out=("pale",)))
    pale_sides = {sides[row["index"]] for row in rows if row["family"] == "pale" and row["status"] == "done"}
    assert pale_sides == {"test"}
    assert {"train", "validation", "test"} <= set(sides.values())


@pytest.mark.parametrize(
    "settings", [{"shares": (0.5, 0.1, 0.1)}, {"shares": (float("nan"), 0.5, 0.5)}, {"held_out": ("blue",)}]
)
def test_a_split_that_is_not_possible_is_refused(settings: dict[str, Any]) -> None:
    rule = DatasetSplit(**settings)
    with pytest.raises(UserError):
        sequence_split.assign_sides(make_rows(anatomies=60), rule)


def test_a_dataset_of_one_brain_is_split_within_it_only_on_request() -> None:
    rows = [{**row, "anatomy": "mesh-1"} for row in make_rows()]
    with pytest.raises(UserError, match=r"--share-anatomy"):
        sequence_split.assign_sides(rows, DatasetSplit("sequence"))
    rule = DatasetSplit("sequence", share_anatomy=True)
    split_rows = [
        {**row, "split": side}
        for row, side in zip(rows, sequence_split.assign_sides(rows, rule), strict=True)
    ]
    assert set(sequence_split.count(split_rows)) == set(sequence_split.SIDES)
    assert not sequence_split.find_leaks(split_rows, rule)
    assert sequence_split.find_leaks(split_rows)[0].startswith("anatomy mesh-1 is in")


def test_openings_of_one_brain_are_on_separate_sides() -> None:
    brain_rows = [
        {**row, "anatomy": "mesh-1", "opening": f"mesh-1 at {row['index'] % 5}"} for row in make_rows()
    ]
    # Procedural brains, which have no opening of their own, stay whole.
    rows = [*brain_rows, *({**row, "index": 60 + row["index"], "opening": None} for row in make_rows())]
    rule = sequence_split.parse_rule("opening", "0.6,0.2,0.2", [])
    split_rows = [
        {**row, "split": side}
        for row, side in zip(rows, sequence_split.assign_sides(rows, rule), strict=True)
    ]
    opening_sides: dict[str, set[str]] = {}
    for row in split_rows:
        if row["status"] == "done":
            opening_sides.setdefault(row["opening"] or row["anatomy"], set()).add(row["split"])
    assert len(opening_sides) == 25
    assert all(len(sides) == 1 for sides in opening_sides.values())
    assert {next(iter(opening_sides[f"mesh-1 at {k}"])) for k in range(5)} == set(sequence_split.SIDES)
    # The procedural rows have the same content hashes as the brain's, which is a leak.
    assert not [
        line for line in sequence_split.find_leaks(split_rows, rule) if not line.startswith("content_hash")
    ]


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
        rows = make_rows(int(rng.integers(20, 120)), int(rng.integers(6, 60)))
        order = rng.permutation(len(rows)).tolist()
        rule = DatasetSplit(by, share_anatomy=draw % 3 == 2, held_out=("calf",) * (draw % 5 == 4))  # type: ignore[arg-type]
        present_rows = list[dict[str, Any]]()
        for batch in np.array_split(order, 4):
            present_rows += [rows[k] for k in batch]
            sides = sequence_split.assign_if_possible(present_rows, rule)
            hash_sides = {
                row["content_hash"]: side for row, side in zip(present_rows, sides, strict=True) if side
            }
            assert rule.sides.items() <= hash_sides.items()
            rule = replace(rule, sides=hash_sides)
            assert not sequence_split.find_leaks(
                [{**row, "split": hash_sides.get(row["content_hash"])} for row in present_rows], rule
            )
            for value in {row["anatomy"] for row in present_rows} if by == "anatomy" else ():
                group_sides = {
                    hash_sides.get(row["content_hash"]) for row in present_rows if row[by] == value
                } - {None}
                assert rule.share_anatomy or len(group_sides) <= 1
        if by == "anatomy" and not rule.held_out and not rule.share_anatomy and hash_sides:
            counts = [list(hash_sides.values()).count(side) for side in sequence_split.SIDES]
            largest = max(sum(row["anatomy"] == other_row["anatomy"] for row in rows) for other_row in rows)
            for count, share in zip(counts, (0.7, 0.15, 0.15), strict=True):
                assert abs(count - share * len(hash_sides)) <= max(2 * largest, 3)


def test_openings_that_share_tissue_are_never_on_two_sides_in_any_order() -> None:
    for draw in range(40):
        rng = np.random.default_rng([36, draw])
        positions = rng.uniform(-60, 60, (int(rng.integers(8, 40)), 3)).round(2)
        brains = rng.integers(0, 2, len(positions)).tolist()
        names = [
            f"mesh-{b} at {x}, {y}, {z}" for b, (x, y, z) in zip(brains, positions.tolist(), strict=True)
        ]
        rows = [
            {
                **make_rows(1)[0],
                "index": k,
                "content_hash": str(k),
                "anatomy": f"mesh-{brains[k]}",
                "opening": name,
            }
            for k, name in enumerate(names)
        ]
        rule = sequence_split.parse_rule("opening", "0.6,0.2,0.2", [], apart_mm=24.0)
        for count in (len(rows) // 2, len(rows)):
            present_rows = rows[:count]
            sides = sequence_split.assign_if_possible(present_rows, rule)
            row_sides = {row["index"]: side for row, side in zip(present_rows, sides, strict=True) if side}
            hash_sides = {
                row["content_hash"]: row_sides[row["index"]]
                for row in present_rows
                if row["index"] in row_sides
            }
            rule = replace(rule, sides=hash_sides)  # type: ignore[arg-type]
            for a in row_sides:
                neighbours = [
                    b
                    for b in row_sides
                    if brains[a] == brains[b] and np.linalg.norm(positions[a] - positions[b]) < 24.0
                ]
                assert {row_sides[b] for b in neighbours} == {row_sides[a]}
