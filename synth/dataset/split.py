"""Who may be trained on: a split of the sequences in which no group is on both sides."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

from pydantic import FiniteFloat, TypeAdapter, ValidationError

from synth.dataset.folder import write_whole
from synth.errors import UserError
from synth.job.types import first_problem
from synth.system import checked_file

By = Literal["anatomy", "opening", "family", "gesture", "stiffness", "sequence"]
"""What must not be shared between the sides: `opening` is the place that a user's brain is opened at, else
the anatomy; `stiffness` splits at quantiles of Young's modulus."""

SIDES = ("train", "validation", "test")
_CLASSES = 10
NAME = "split.json"


@dataclass(frozen=True)
class Rule:
    """How a dataset is split; kept beside it, so that one that grows is split as before."""

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
        at, why = first_problem(error)
        raise UserError(f"{root / NAME}: is damaged ({at or 'all of it'}: {why})") from None


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
    by, shares, held_out, share_anatomy = chosen.by, chosen.shares, chosen.held_out, chosen.share_anatomy
    if len(shares) != 3 or abs(sum(shares) - 1) > 1e-6 or min(shares) < 0:
        raise UserError(f"shares {shares}: must not be negative and must sum to 1")
    done = [row for row in rows if row["status"] == "done"]
    strangers = set(held_out) - {str(row["family"]) for row in done}
    if strangers:
        raise UserError(f"family {', '.join(sorted(strangers))}: no sequence has it")
    if by == "stiffness" and any(row["young_kpa"] is None for row in done):
        raise UserError("by stiffness: a sequence says nothing of its Young's modulus")
    group = _groups(done, by, chosen.share_anatomy)
    sealed = {group[row["index"]] for row in done if row["family"] in held_out}
    sizes: dict[str, int] = {}
    for row in done:
        name = group[row["index"]]
        sizes[name] = sizes.get(name, 0) + 1
    side = dict.fromkeys(sealed, "test")
    wanted = [share * len(done) for share in shares]
    wanted[2] -= sum(sizes[name] for name in sealed)
    free = sorted(sizes.keys() - sealed, key=lambda name: (-sizes[name], _shuffled(name)))
    sides = [k for k in range(3) if shares[k] > 0]
    if len(free) + bool(sealed) < len(sides):
        hint = "; --share-anatomy splits within a brain, for a model of that brain alone"
        if share_anatomy:
            hint = "; craniotomy.also in the job lists further openings" if by == "opening" else ""
        needing = ", ".join(SIDES[k] for k in sides)
        raise UserError(f"{len(sizes)} groups by {by}: too few for {needing} to have one each{hint}")
    for name in free:
        # The side that lacks most, in proportion, gets the next group.
        best = max(sides, key=lambda k: (wanted[k] / max(shares[k], 1e-9), -k))
        side[name] = SIDES[best]
        wanted[best] -= sizes[name]
    return [side[group[row["index"]]] if row["status"] == "done" else None for row in rows]


def leaks(rows: Sequence[Mapping[str, Any]], chosen: Rule | None = None) -> list[str]:
    """Anatomies and contents that are on more than one side, and held-out families that are trained on."""
    chosen, found = chosen or Rule(), []
    for row in rows:
        if row["status"] == "done" and row.get("split") in SIDES[:2] and row["family"] in chosen.held_out:
            found.append(f"family {row['family']} is held out and in {row['split']}")
    done = [row for row in rows if row["status"] == "done" and row.get("split")]
    told = {"content_hash": [row["content_hash"] for row in done]}
    if not chosen.share_anatomy:
        told = {"anatomy": [row["anatomy"] for row in done], **told}
    elif chosen.by == "opening":
        told = {"opening": [_name_opening(row) for row in done], **told}
    for name, keys in told.items():
        crossing = find_crossings(keys, [row["split"] for row in done])
        found += [f"{name} {key} is in {', '.join(on)}" for key, on in crossing.items()]
    return found


def warn_of_strangers(rows: Sequence[Mapping[str, Any]], chosen: Rule) -> str | None:
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


def _groups(rows: Sequence[Mapping[str, Any]], by: By, share_anatomy: bool) -> dict[int, str]:
    """A group's name for every index; groups that share an anatomy are one unless the rule allows it."""
    if by == "stiffness":
        ordered = sorted(float(row["young_kpa"]) for row in rows)
        edges = [ordered[k * len(ordered) // _CLASSES] for k in range(1, _CLASSES)]
        named = {row["index"]: f"E{sum(row['young_kpa'] >= edge for edge in edges)}" for row in rows}
    elif by == "sequence":
        named = {row["index"]: str(row["content_hash"]) for row in rows}
    elif by == "opening":
        named = {row["index"]: _name_opening(row) for row in rows}
    else:
        named = {row["index"]: str(row[by]) for row in rows}
    if share_anatomy:
        return named
    names, least = list(named.values()), dict[int, str]()
    number = join_groups(names, [row["anatomy"] for row in rows])
    for group, name in zip(number, names, strict=True):
        least[group] = min(name, least.get(group, name))
    return {key: least[group] for key, group in zip(named, number, strict=True)}


def _name_opening(row: Mapping[str, Any]) -> str:
    """A procedural brain, which is opened at one place, and stores that don't say where: the anatomy."""
    return str(row.get("opening") or row["anatomy"])


def _shuffled(name: str) -> str:
    return hashlib.blake2b(name.encode(), digest_size=8).hexdigest()
