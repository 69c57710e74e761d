"""The split of a dataset into train, validation and test: no group is on two sides."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from pydantic import FiniteFloat

from synth.dataset.dataset_folder import write_whole
from synth.errors import UserError
from synth.job import identity
from synth.system import checked_file
from synth.system.config_file import validate_values

By = Literal["anatomy", "opening", "sequence"]
"""Groups that must not be on two sides: `opening` is the craniotomy of a user's brain, else the anatomy."""

Side = Literal["train", "validation", "test"]
SIDES: tuple[Side, ...] = get_args(Side)
Group = TypeVar("Group", int, str)
NAME = "split.json"


@dataclass(frozen=True)
class DatasetSplit:
    """How a dataset is split, and the side of every sequence: `split.json`."""

    by: By = "anatomy"
    shares: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (0.7, 0.15, 0.15)
    held_out: tuple[str, ...] = ()
    share_anatomy: bool = False  # one brain may be on several sides: scores don't hold for other brains
    apart_mm: FiniteFloat = 0.0  # by opening: those of a brain that are closer share tissue and are one group
    sides: Mapping[str, Side] = field(default_factory=dict)  # content hash -> side

    @property
    def hash(self) -> str:
        """Hash of all sides."""
        return identity.digest(dict(self.sides))

    def find(self, names: Iterable[str], label: Path | str) -> list[Side]:
        """The sides of sequences by their content hashes; UserError if one has none."""
        sides = [self.sides.get(name) for name in names]
        if unassigned := sides.count(None):
            raise UserError(
                f"{label}: {unassigned} of its {len(sides)} sequences have no side in {NAME}: `synth report` "
                "assigns new sequences, `synth split` replaces the split"
            )
        return [side for side in sides if side]


def read_stored(root: Path) -> DatasetSplit:
    """A dataset's `split.json`; the default without sides if it is missing. UserError if it is damaged."""
    if not os.path.lexists(root / NAME):
        return DatasetSplit()
    return validate_values(DatasetSplit, checked_file.read_json(root / NAME), f"{root / NAME}: is damaged")


def store(root: Path, split: DatasetSplit) -> None:
    """Stores the split of the dataset in `root`."""
    write_whole(root / NAME, json.dumps(asdict(split), indent=1) + "\n")


def parse_rule(
    by: str, shares: str, held_out: Sequence[str], share_anatomy: bool = False, apart_mm: float = 0.0
) -> DatasetSplit:
    """A command line's split, without sides; `by` opening implies `share_anatomy`. May raise UserError."""
    sharing = share_anatomy or by == "opening"
    values = {"by": by, "shares": shares.split(","), "held_out": held_out, "share_anatomy": sharing}
    return validate_values(DatasetSplit, values | {"apart_mm": apart_mm}, f"by {by}, shares {shares}")


def count(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Number of sequences on each side."""
    sides = [row.get("split") for row in rows]
    return {side: sides.count(side) for side in SIDES if side in sides}


def assign_sides(rows: Sequence[Mapping[str, Any]], split: DatasetSplit) -> list[Side | None]:
    """The side of every row of the index; None for a failed sequence.

    Sequences keep their side, and new ones get that of their group; None if it joins groups on two sides.
    Other groups are assigned so as to approximate the shares, by their names, not by the order of rows.
    Groups with a held-out family are in the test set. UserError: an unknown family, shares that do not sum to
    1, or fewer groups than sides.
    """
    by, shares = split.by, split.shares
    if not (abs(sum(shares) - 1) <= 1e-6 and min(shares) >= 0):  # NaN is neither
        raise UserError(f"shares {shares}: must not be negative and must sum to 1")
    done = [row for row in rows if row["status"] == "done"]
    unknown = set(split.held_out) - {str(row["family"]) for row in done}
    if unknown and not split.sides:
        raise UserError(f"family {', '.join(sorted(unknown))}: no sequence has it")
    groups, stored = _groups(done, split), [split.sides.get(row["content_hash"]) for row in done]
    sides_of: dict[str, set[int]] = {}
    for group, side, row in zip(groups, stored, done, strict=True):
        sides_of.setdefault(group, set()).update([SIDES.index(side)] if side else [])
        sides_of[group] |= {2} if row["family"] in split.held_out else set()
    fixed = {group: max(sides) for group, sides in sides_of.items() if sides}
    needing = {k for k, share in enumerate(shares) if share > 0} - set(fixed.values())
    if len(sides_of) - len(fixed) < len(needing) and not split.sides:
        hint = "render more sequences (`sequences` in the job)"
        if split.share_anatomy and by == "opening":
            hint = "list further openings in craniotomy.also of the job"
        elif len(sides_of) < len(done) and not split.share_anatomy:
            hint += ", or split within a brain by `synth split --by opening` or --share-anatomy"
        needed_sides = [SIDES[k] for k in sorted(needing | set(fixed.values()))]
        shortage = (
            f"{len(done)} sequences form {len(sides_of)} groups by {by}, but {len(needed_sides)} are needed"
        )
        raise UserError(f"{shortage}, one each for {', '.join(needed_sides)}: {hint}")
    order = sorted(sides_of, key=lambda name: hashlib.blake2b(name.encode(), digest_size=8).hexdigest())
    part = draw_groups(groups, shares, order, fixed)
    new_sides = [
        SIDES[k] if len(sides_of[group]) < 2 else None for group, k in zip(groups, part, strict=True)
    ]
    sides = {row["index"]: old or new for row, old, new in zip(done, stored, new_sides, strict=True)}
    return [sides.get(row["index"]) for row in rows]


def draw_groups(
    groups: Sequence[Group],
    shares: Sequence[float],
    order: Sequence[Group],
    fixed: Mapping[Group, int] | None = None,
) -> list[int]:
    """The part (0, 1, ...) of each of N members, by its group; no group is in two parts.

    Larger groups are assigned first, those of equal size in `order`. `shares`: of each part, in any unit; one
    of 0 stays empty. `fixed`: parts of groups that are assigned already.
    """
    size = Counter(groups)
    part = dict(fixed or {})
    deficits = [share * len(groups) for share in shares]
    for group, k in part.items():
        deficits[k] -= size[group]
    open_parts = [k for k, share in enumerate(shares) if share > 0]
    for group in sorted(
        (candidate for candidate in order if candidate not in part), key=lambda candidate: -size[candidate]
    ):
        # The part that lacks most in proportion to its share gets the next group.
        part[group] = max(open_parts, key=lambda k: (deficits[k] / max(shares[k], 1e-9), -k))
        deficits[part[group]] -= size[group]
    return [part[group] for group in groups]


def assign_if_possible(rows: Sequence[Mapping[str, Any]], split: DatasetSplit) -> list[Side | None]:
    """As `assign_sides`; no sides if there are too few groups."""
    try:
        return assign_sides(rows, split)
    except UserError:
        return [None] * len(rows)


def find_misplaced(rows: Sequence[Mapping[str, Any]], split: DatasetSplit) -> list[str]:
    """Messages on sequences whose side in the index is missing or differs from the split."""
    return [
        f"sequence {row['index']} is in {row['split']}, by the split in {side}"
        for row, side in zip(rows, assign_if_possible(rows, split), strict=True)
        if row["split"] != side or (split.sides and row["status"] == "done" and side is None)
    ]


def find_leaks(rows: Sequence[Mapping[str, Any]], split: DatasetSplit = DatasetSplit()) -> list[str]:
    """Messages on anatomies and contents on more than one side, and on held-out families in training."""
    done = [row for row in rows if row["status"] == "done" and row.get("split")]
    messages = [
        f"family {row['family']} is held out and in {row['split']}"
        for row in done
        if row["split"] in SIDES[:2] and row["family"] in split.held_out
    ]
    keys = {"content_hash": [row["content_hash"] for row in done]}
    if not split.share_anatomy:
        keys = {"anatomy": [row["anatomy"] for row in done], **keys}
    elif split.by == "opening":
        keys = {"opening": _groups(done, split), **keys}
    for name, values in keys.items():
        crossing = find_crossings(values, [row["split"] for row in done])
        messages += [f"{name} {key} is in {', '.join(sides)}" for key, sides in crossing.items()]
    return messages


def find_crossings(groups: Sequence[Hashable], sides: Sequence[str]) -> dict[Hashable, list[str]]:
    """Groups on more than one side, with those sides. `groups` and `sides` have one entry per sequence."""
    sides_of: dict[Hashable, set[str]] = {}
    for group, side in zip(groups, sides, strict=True):
        sides_of.setdefault(group, set()).add(side)
    return {group: sorted(group_sides) for group, group_sides in sides_of.items() if len(group_sides) > 1}


def join_groups(*keys: Sequence[Hashable]) -> list[int]:
    """A number for each sequence's group, the position of its first: connected components of those sharing a
    key.

    `keys`: properties that must not be on two sides, one value per sequence each.
    """
    # By hand, as every command would import SciPy's clustering for it: a quarter of its start.
    group, first = [*range(len(keys[0]))], dict[Hashable, int]()

    def root(k: int) -> int:
        while group[k] != k:
            group[k] = k = group[group[k]]
        return k

    for kind, values in enumerate(keys):
        for k, value in enumerate(values):
            low, high = sorted((root(k), root(first.setdefault((kind, value), k))))
            group[high] = low
    return [root(k) for k in range(len(group))]


def name_anatomy(attrs: Mapping[str, Any]) -> str:
    """The name of a sequence's anatomy, equal in all datasets; its own content hash if it has none."""
    return str(attrs.get("anatomy_id") or attrs["content_hash"])


def _groups(rows: Sequence[Mapping[str, Any]], split: DatasetSplit) -> list[str]:
    """The group of every row; groups that share an anatomy are merged unless the rule allows sharing."""
    if split.by == "opening":
        names = _join_openings([str(row.get("opening") or row["anatomy"]) for row in rows], split.apart_mm)
    else:
        names = [str(row["content_hash" if split.by == "sequence" else "anatomy"]) for row in rows]
    if split.share_anatomy:
        return names
    numbers, first = join_groups(names, [row["anatomy"] for row in rows]), dict[int, str]()
    for group, name in zip(numbers, names, strict=True):
        first[group] = min(name, first.get(group, name))
    return [first[group] for group in numbers]


def _join_openings(names: Sequence[str], apart_mm: float) -> list[str]:
    """Names of openings (of `synth.job.identity`), with one name for those of a brain that overlap."""
    located = sorted({name for name in names if " at " in name})
    if not located:
        return list(names)
    brains, places = zip(*(name.split(" at ") for name in located), strict=True)
    from scipy.sparse.csgraph import connected_components  # of brains of users alone
    from scipy.spatial.distance import cdist

    distance_mm = cdist(*[np.array([place.split(",") for place in places], float)] * 2)
    same_brain = np.array(brains)[:, None] == np.array(brains)
    part = connected_components(same_brain & (distance_mm < apart_mm))[1].tolist()
    merged = {name: located[part.index(k)] for name, k in zip(located, part, strict=True)}
    return [merged.get(name, name) for name in names]
