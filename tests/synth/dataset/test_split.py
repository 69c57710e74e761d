"""Splits: no group on two sides, held-out families never trained on, order without effect."""

from __future__ import annotations

from typing import Any

import pytest

from synth.dataset import split
from synth.dataset.split import Rule
from synth.errors import UserError


def rows(count: int = 60, anatomies: int = 20) -> list[dict[str, Any]]:
    return [
        {
            "index": k,
            "status": "done" if k != 7 else "failed",
            "anatomy": k % anatomies,
            "family": ("healthy", "pale", "calf")[k % anatomies % 3],
            "gesture": ("pull", "push")[k % 2],
            "young_kpa": 0.5 + (k * 37 % count) / count,
            "content_hash": str(k),
        }
        for k in range(count)
    ]


def sides(found: list[dict[str, Any]], rule: Rule) -> dict[int, str | None]:
    return {row["index"]: side for row, side in zip(found, split.assign_sides(found, rule), strict=True)}


def test_no_anatomy_is_on_two_sides_and_shares_are_kept() -> None:
    found = rows()
    given = sides(found, Rule())
    assert given[7] is None
    for anatomy in range(20):
        assert len({given[k] for k in range(60) if k % 20 == anatomy and k != 7}) == 1
    counts = split.count([{"split": side} for side in given.values()])
    for side, share in zip(split.SIDES, (0.7, 0.15, 0.15), strict=True):
        assert abs(counts[side] - 59 * share) <= 3, "an anatomy has three sequences"


def test_order_does_not_matter() -> None:
    found = rows()
    assert sides(found, Rule()) == sides(found[::-1], Rule())


def test_a_held_out_family_is_only_for_testing() -> None:
    found = rows()
    given = sides(found, Rule(held_out=("pale",)))
    for row in found:
        if row["family"] == "pale" and row["status"] == "done":
            assert given[row["index"]] == "test"
    assert {"train", "validation", "test"} <= set(given.values())


@pytest.mark.parametrize("by", ["family", "stiffness", "gesture"])
def test_other_groups_still_never_share_an_anatomy(by: str) -> None:
    found = rows(anatomies=60)
    rule = Rule(by=by, shares=(0.5, 0.0, 0.5))  # type: ignore[arg-type]
    given = sides(found, rule)
    assert set(given.values()) == {"train", "test", None}
    assert not split.leaks([{**row, "split": given[row["index"]]} for row in found])
    if by != "stiffness":
        for value in {row[by] for row in found}:
            on = {given[row["index"]] for row in found if row[by] == value and row["status"] == "done"}
            assert len(on) == 1


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (Rule(shares=(0.5, 0.1, 0.1)), "must sum to 1"),
        (Rule(shares=(float("nan"), 0.5, 0.5)), "must sum to 1"),
        (Rule(held_out=("blue",)), "family blue: no sequence has it"),
        (Rule(by="gesture"), "too few"),
    ],
)
def test_what_cannot_be_split_is_said_so(rule: Rule, message: str) -> None:
    with pytest.raises(UserError, match=message):
        split.assign_sides(rows(anatomies=60), rule)


def test_a_dataset_of_one_brain_is_split_within_it_only_when_told() -> None:
    found = [{**row, "anatomy": "mesh-1"} for row in rows()]
    with pytest.raises(UserError, match=r"1 groups by sequence: too few .*--share-anatomy"):
        split.assign_sides(found, Rule("sequence"))
    rule = Rule("sequence", share_anatomy=True)
    given = [{**row, "split": side} for row, side in zip(found, split.assign_sides(found, rule), strict=True)]
    assert set(split.count(given)) == set(split.SIDES)
    assert not split.leaks(given, rule)
    assert split.leaks(given)[0].startswith("anatomy mesh-1 is in")


def test_openings_of_one_brain_are_kept_apart_and_said_to_be_no_strangers() -> None:
    brain = [{**row, "anatomy": "mesh-1", "opening": f"mesh-1 at {row['index'] % 5}"} for row in rows()]
    # Beside it procedural brains, which have no opening of their own: those stay whole.
    found = [*brain, *({**row, "index": 60 + row["index"], "opening": None} for row in rows())]
    rule = split.parse_rule("opening", "0.6,0.2,0.2", [])
    given = [{**row, "split": side} for row, side in zip(found, split.assign_sides(found, rule), strict=True)]
    on: dict[str, set[str]] = {}
    for row in given:
        if row["status"] == "done":
            on.setdefault(row["opening"] or row["anatomy"], set()).add(row["split"])
    assert len(on) == 25
    assert all(len(sides) == 1 for sides in on.values())
    assert {next(iter(on[f"mesh-1 at {k}"])) for k in range(5)} == set(split.SIDES)
    # The procedural rows have the same contents as the brain's: only that is a leak here.
    assert not [line for line in split.leaks(given, rule) if not line.startswith("content_hash")]
    warning = split.warn_of_shared_brains(given, rule)
    assert warning is not None
    assert warning.startswith("1 brain is on several sides: openings of one brain are no strangers")


def test_groups_are_joined_by_any_key_and_through_others() -> None:
    anatomies, hashes = "abcadef", "1234562"
    # a: 0 and 3; the hash 2: 1 and 6; all others alone.
    assert split.join_groups(anatomies, hashes) == [0, 1, 2, 0, 4, 5, 1]
    # 5 and 0 by the third key, and so 3.
    assert split.join_groups(anatomies, hashes, "xyzuvxw") == [0, 1, 2, 0, 4, 0, 1]
    assert split.find_crossings([0, 1, 0, 1], ["fit", "test", "test", "test"]) == {0: ["fit", "test"]}
