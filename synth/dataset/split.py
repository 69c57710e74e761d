"""Who may be trained on: a split of the sequences in which no group is on both sides."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args

import numpy as np
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from synth.dataset.folder import write_whole
from synth.errors import UserError
from synth.system import checked_file
from synth.system.config_file import first_mistake

By = Literal["anatomy", "opening", "family", "gesture", "stiffness", "sequence"]
"""What must not be shared between the sides: `opening` is the place that a user's brain is opened at, else
the anatomy; `stiffness` splits at quantiles of Young's modulus."""

SIDES = ("train", "validation", "test")
_CLASSES = 10
Group = TypeVar("Group", int, str)
NAME = "split.json"


@dataclass(frozen=True)
class Rule:
    """How a dataset is split; stored in it, so that one that grows is split as before."""

    by: By = "anatomy"
    shares: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (0.7, 0.15, 0.15)
    held_out: tuple[str, ...] = ()
    share_anatomy: bool = False
    """Whether one brain may be on several sides: scores then say nothing of other brains."""


def is_written(root: Path) -> bool:
    """Whether the dataset in `root` was given a rule of its own (`synth split`)."""
    return (root / NAME).exists()


def read_rule(root: Path) -> Rule:
    """The rule of the dataset in `root`; the default if none was given. UserError for what is none."""
    if not os.path.lexists(root / NAME):
        return Rule()
    found = checked_file.read_json(root / NAME)
    try:
        return TypeAdapter(Rule).validate_python(found)
    except ValidationError as error:
        raise UserError(f"{root / NAME}: is damaged ({first_mistake(error)})") from None


def keep_rule(root: Path, chosen: Rule) -> None:
    """Makes `chosen` the rule of the dataset in `root`."""
    write_whole(root / NAME, json.dumps(asdict(chosen), indent=1) + "\n")


def parse_rule(by: str, shares: str, held_out: Sequence[str], share_anatomy: bool = False) -> Rule:
    """A rule from the words of a command line, UserError for what is none; by opening, a brain is shared."""
    if by not in get_args(By):
        raise UserError(f"by {by}: is not one of {', '.join(get_args(By))}")
    try:
        train, validation, test = (float(word) for word in shares.split(","))
    except ValueError:
        raise UserError(f"shares {shares}: three numbers are needed, as 0.7,0.15,0.15") from None
    return Rule(cast(By, by), (train, validation, test), tuple(held_out), share_anatomy or by == "opening")


def count(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Sequences on each side."""
    sides = [row.get("split") for row in rows]
    return {side: sides.count(side) for side in SIDES if side in sides}


def assign_sides(rows: Sequence[Mapping[str, Any]], chosen: Rule) -> list[str | None]:
    """The side of every row of the index; None for a sequence that failed.

    A group's side depends on the group's name and on which groups there are, not on the order of rows.
    Sequences of a family that is held out are always for testing; any group that they share goes with them.

    Raises:
        UserError: a family that is not there, shares that do not sum to 1, or fewer groups than sides.
    """
    by, shares = chosen.by, chosen.shares
    if len(shares) != 3 or not (abs(sum(shares) - 1) <= 1e-6 and min(shares) >= 0):  # NaN is neither
        raise UserError(f"shares {shares}: must not be negative and must sum to 1")
    done = [row for row in rows if row["status"] == "done"]
    unknown = set(chosen.held_out) - {str(row["family"]) for row in done}
    if unknown:
        raise UserError(f"family {', '.join(sorted(unknown))}: no sequence has it")
    if by == "stiffness" and any(row["young_kpa"] is None for row in done):
        raise UserError("by stiffness: a sequence says nothing of its Young's modulus")
    groups = _groups(done, chosen)
    held_out = {group for group, row in zip(groups, done, strict=True) if row["family"] in chosen.held_out}
    needing = [side for side, share in zip(SIDES, shares, strict=True) if share > 0]
    names = set(groups)
    if len(names - held_out) + bool(held_out) < len(needing):
        hint = "; --share-anatomy splits within a brain, for a model of that brain alone"
        if chosen.share_anatomy:
            hint = "; craniotomy.also in the job lists further openings" if by == "opening" else ""
        few = f"{len(names)} groups by {by}: too few"
        raise UserError(f"{few} for {', '.join(needing)} to have one each{hint}")
    order = sorted(names, key=lambda name: hashlib.blake2b(name.encode(), digest_size=8).hexdigest())
    part = draw_groups(groups, shares, order, fixed=dict.fromkeys(held_out, 2))
    side = {row["index"]: SIDES[k] for row, k in zip(done, part, strict=True)}
    return [side.get(row["index"]) for row in rows]


def draw_groups(
    groups: Sequence[Group],
    shares: Sequence[float],
    order: int | Sequence[Group],
    fixed: Mapping[Group, int] | None = None,
) -> list[int]:
    """The part (0, 1, ...) of each member; no group is in two parts. Larger groups are dealt first.

    Args:
        groups: (N,) the group of each member.
        shares: of each part, in any unit; a part of share 0 gets nothing.
        order: of groups of one size: a seed, or the groups themselves.
        fixed: parts of groups that aren't drawn.
    """
    size = Counter(groups)
    if isinstance(order, int):
        names = sorted(size)
        order = [names[k] for k in np.random.default_rng(order).permutation(len(names))]
    part = dict(fixed or {})
    lacking = [
        share * len(groups) - sum(size[group] for group in part if part[group] == k)
        for k, share in enumerate(shares)
    ]
    open_parts = [k for k, share in enumerate(shares) if share > 0]
    for group in sorted((one for one in order if one not in part), key=lambda one: -size[one]):
        # The part that lacks most, in proportion, gets the next group.
        part[group] = max(open_parts, key=lambda k: (lacking[k] / max(shares[k], 1e-9), -k))
        lacking[part[group]] -= size[group]
    return [part[group] for group in groups]


def assign_if_possible(rows: Sequence[Mapping[str, Any]], chosen: Rule) -> list[str | None]:
    """`assign_sides`; no sides where there are too few groups to have some on each."""
    try:
        return assign_sides(rows, chosen)
    except UserError:
        return [None] * len(rows)


def misplaced(rows: Sequence[Mapping[str, Any]], chosen: Rule) -> list[str]:
    """Sequences that the index puts on another side than the rule does."""
    return [
        f"sequence {row['index']} is in {row['split']}, by the rule in {side}"
        for row, side in zip(rows, assign_if_possible(rows, chosen), strict=True)
        if row["split"] != side
    ]


def leaks(rows: Sequence[Mapping[str, Any]], chosen: Rule | None = None) -> list[str]:
    """Anatomies and contents that are on more than one side, and held-out families that are trained on."""
    chosen = chosen or Rule()
    done = [row for row in rows if row["status"] == "done" and row.get("split")]
    found = [
        f"family {row['family']} is held out and in {row['split']}"
        for row in done
        if row["split"] in SIDES[:2] and row["family"] in chosen.held_out
    ]
    keys = {"content_hash": [row["content_hash"] for row in done]}
    if not chosen.share_anatomy:
        keys = {"anatomy": [row["anatomy"] for row in done], **keys}
    elif chosen.by == "opening":
        keys = {"opening": [_name_opening(row) for row in done], **keys}
    for name, values in keys.items():
        crossing = find_crossings(values, [row["split"] for row in done])
        found += [f"{name} {key} is in {', '.join(on)}" for key, on in crossing.items()]
    return found


def warn_of_shared_brains(rows: Sequence[Mapping[str, Any]], chosen: Rule) -> str | None:
    """What to say of brains that are on several sides; None if there are none."""
    done = [row for row in rows if row["status"] == "done" and row.get("split")]
    count = len(find_crossings([row["anatomy"] for row in done], [row["split"] for row in done]))
    if not count:
        return None
    parts = "openings" if chosen.by == "opening" else "sequences"
    brains = "1 brain is" if count == 1 else f"{count} brains are"
    nothing = "scores say nothing of other brains"
    return f"{brains} on several sides: {parts} of one brain are no strangers, and {nothing}"


def find_crossings(groups: Sequence[Hashable], sides: Sequence[str]) -> dict[Hashable, list[str]]:
    """Groups that are on more than one side, and on which: there must be none. One entry a sequence."""
    on: dict[Hashable, set[str]] = {}
    for group, side in zip(groups, sides, strict=True):
        on.setdefault(group, set()).add(side)
    return {group: sorted(found) for group, found in on.items() if len(found) > 1}


def join_groups(*keys: Sequence[Hashable]) -> list[int]:
    """A number for each sequence, equal where two share a key or are joined by others that do.

    `keys`: of everything that must not be on two sides, one value a sequence. The number is the place of the
    group's first sequence.
    """
    root = list(range(len(keys[0])))

    def find(i: int) -> int:
        while root[i] != i:
            root[i] = root[root[i]]
            i = root[i]
        return i

    for values in keys:
        first: dict[Hashable, int] = {}
        for i, value in enumerate(values):
            here, there = find(i), find(first.setdefault(value, i))
            root[max(here, there)] = min(here, there)
    return [find(i) for i in range(len(root))]


def name_anatomy(attrs: Mapping[str, Any]) -> str:
    """What names a sequence's anatomy across datasets: `anatomy_id`, in older stores the seed of the relief;
    a sequence with neither is alone. All sequences of one user's brain are one anatomy."""
    named = attrs.get("anatomy_id")
    if named is not None:
        return str(named)
    seed = ((attrs.get("scenario") or {}).get("relief") or {}).get("seed")
    return str(attrs["content_hash"]) if seed is None else f"seed-{seed}"


def _groups(rows: Sequence[Mapping[str, Any]], chosen: Rule) -> list[str]:
    """A group's name for every row; groups that share an anatomy are one unless the rule allows it."""
    if chosen.by == "stiffness":
        ordered = sorted(float(row["young_kpa"]) for row in rows)
        edges = [ordered[k * len(ordered) // _CLASSES] for k in range(1, _CLASSES)]
        names = [f"E{sum(row['young_kpa'] >= edge for edge in edges)}" for row in rows]
    elif chosen.by == "opening":
        names = [_name_opening(row) for row in rows]
    else:
        names = [str(row["content_hash" if chosen.by == "sequence" else chosen.by]) for row in rows]
    if chosen.share_anatomy:
        return names
    joined, first = join_groups(names, [row["anatomy"] for row in rows]), dict[int, str]()
    for group, name in zip(joined, names, strict=True):
        first[group] = min(name, first.get(group, name))
    return [first[group] for group in joined]


def _name_opening(row: Mapping[str, Any]) -> str:
    """A procedural brain, which is opened at one place, and stores that don't say where: the anatomy."""
    return str(row.get("opening") or row["anatomy"])
