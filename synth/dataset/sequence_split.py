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
from synth.system.config_file import validated

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

    def find(self, names: Iterable[str], where: Path | str) -> list[Side]:
        """The sides of sequences by their content hashes; UserError if one has none."""
        found = [self.sides.get(name) for name in names]
        if lost := found.count(None):
            raise UserError(
                f"{where}: {lost} of its {len(found)} sequences have no side in {NAME}: `synth report` "
                "assigns new sequences, `synth split` replaces the split"
            )
        return [side for side in found if side]


def read_stored(root: Path) -> DatasetSplit:
    """A dataset's `split.json`; the default without sides if it is missing. UserError if it is damaged."""
    if not os.path.lexists(root / NAME):
        return DatasetSplit()
    return validated(DatasetSplit, checked_file.read_json(root / NAME), f"{root / NAME}: is damaged")


def store(root: Path, chosen: DatasetSplit) -> None:
    """Stores the split of the dataset in `root`."""
    write_whole(root / NAME, json.dumps(asdict(chosen), indent=1) + "\n")


def parse_rule(
    by: str, shares: str, held_out: Sequence[str], share_anatomy: bool = False, apart_mm: float = 0.0
) -> DatasetSplit:
    """A command line's split, without sides; `by` opening implies `share_anatomy`. May raise UserError."""
    shared = share_anatomy or by == "opening"
    given = {"by": by, "shares": shares.split(","), "held_out": held_out, "share_anatomy": shared}
    return validated(DatasetSplit, given | {"apart_mm": apart_mm}, f"by {by}, shares {shares}")


def count(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Number of sequences on each side."""
    sides = [row.get("split") for row in rows]
    return {side: sides.count(side) for side in SIDES if side in sides}


def assign_sides(rows: Sequence[Mapping[str, Any]], chosen: DatasetSplit) -> list[Side | None]:
    """The side of every row of the index; None for a failed sequence.

    Sequences keep their side, and new ones get that of their group; None if it joins groups on two sides.
    Other groups are assigned so as to approximate the shares, by their names, not by the order of rows.
    Groups with a held-out family are in the test set. UserError: an unknown family, shares that do not sum to
    1, or fewer groups than sides.
    """
    by, shares = chosen.by, chosen.shares
    if not (abs(sum(shares) - 1) <= 1e-6 and min(shares) >= 0):  # NaN is neither
        raise UserError(f"shares {shares}: must not be negative and must sum to 1")
    done = [row for row in rows if row["status"] == "done"]
    unknown = set(chosen.held_out) - {str(row["family"]) for row in done}
    if unknown and not chosen.sides:
        raise UserError(f"family {', '.join(sorted(unknown))}: no sequence has it")
    groups, stored = _groups(done, chosen), [chosen.sides.get(row["content_hash"]) for row in done]
    on: dict[str, set[int]] = {}
    for group, side, row in zip(groups, stored, done, strict=True):
        on.setdefault(group, set()).update([SIDES.index(side)] if side else [])
        on[group] |= {2} if row["family"] in chosen.held_out else set()
    fixed = {group: max(sides) for group, sides in on.items() if sides}
    needing = {k for k, share in enumerate(shares) if share > 0} - set(fixed.values())
    if len(on) - len(fixed) < len(needing) and not chosen.sides:
        hint = "render more sequences (`sequences` in the job)"
        if chosen.share_anatomy and by == "opening":
            hint = "list further openings in craniotomy.also of the job"
        elif len(on) < len(done) and not chosen.share_anatomy:
            hint += ", or split within a brain by `synth split --by opening` or --share-anatomy"
        each = [SIDES[k] for k in sorted(needing | set(fixed.values()))]
        few = f"{len(done)} sequences form {len(on)} groups by {by}, but {len(each)} are needed"
        raise UserError(f"{few}, one each for {', '.join(each)}: {hint}")
    order = sorted(on, key=lambda name: hashlib.blake2b(name.encode(), digest_size=8).hexdigest())
    part = draw_groups(groups, shares, order, fixed)
    dealt = [SIDES[k] if len(on[group]) < 2 else None for group, k in zip(groups, part, strict=True)]
    sides = {row["index"]: old or new for row, old, new in zip(done, stored, dealt, strict=True)}
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
    lacking = [share * len(groups) for share in shares]
    for group, k in part.items():
        lacking[k] -= size[group]
    open_parts = [k for k, share in enumerate(shares) if share > 0]
    for group in sorted((one for one in order if one not in part), key=lambda one: -size[one]):
        # The part that lacks most in proportion to its share gets the next group.
        part[group] = max(open_parts, key=lambda k: (lacking[k] / max(shares[k], 1e-9), -k))
        lacking[part[group]] -= size[group]
    return [part[group] for group in groups]


def assign_if_possible(rows: Sequence[Mapping[str, Any]], chosen: DatasetSplit) -> list[Side | None]:
    """As `assign_sides`; no sides if there are too few groups."""
    try:
        return assign_sides(rows, chosen)
    except UserError:
        return [None] * len(rows)


def misplaced(rows: Sequence[Mapping[str, Any]], chosen: DatasetSplit) -> list[str]:
    """Messages on sequences whose side in the index is missing or differs from the split."""
    return [
        f"sequence {row['index']} is in {row['split']}, by the split in {side}"
        for row, side in zip(rows, assign_if_possible(rows, chosen), strict=True)
        if row["split"] != side or (chosen.sides and row["status"] == "done" and side is None)
    ]


def leaks(rows: Sequence[Mapping[str, Any]], chosen: DatasetSplit = DatasetSplit()) -> list[str]:
    """Messages on anatomies and contents on more than one side, and on held-out families in training."""
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
        keys = {"opening": _groups(done, chosen), **keys}
    for name, values in keys.items():
        crossing = find_crossings(values, [row["split"] for row in done])
        found += [f"{name} {key} is in {', '.join(on)}" for key, on in crossing.items()]
    return found


def find_crossings(groups: Sequence[Hashable], sides: Sequence[str]) -> dict[Hashable, list[str]]:
    """Groups on more than one side, with those sides. `groups` and `sides` have one entry per sequence."""
    on: dict[Hashable, set[str]] = {}
    for group, side in zip(groups, sides, strict=True):
        on.setdefault(group, set()).add(side)
    return {group: sorted(found) for group, found in on.items() if len(found) > 1}


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

    for which, values in enumerate(keys):
        for k, value in enumerate(values):
            low, high = sorted((root(k), root(first.setdefault((which, value), k))))
            group[high] = low
    return [root(k) for k in range(len(group))]


def name_anatomy(attrs: Mapping[str, Any]) -> str:
    """The name of a sequence's anatomy, equal in all datasets; its own content hash if it has none."""
    return str(attrs.get("anatomy_id") or attrs["content_hash"])


def _groups(rows: Sequence[Mapping[str, Any]], chosen: DatasetSplit) -> list[str]:
    """The group of every row; groups that share an anatomy are merged unless the rule allows sharing."""
    if chosen.by == "opening":
        names = _join_openings([str(row.get("opening") or row["anatomy"]) for row in rows], chosen.apart_mm)
    else:
        names = [str(row["content_hash" if chosen.by == "sequence" else "anatomy"]) for row in rows]
    if chosen.share_anatomy:
        return names
    joined, first = join_groups(names, [row["anatomy"] for row in rows]), dict[int, str]()
    for group, name in zip(joined, names, strict=True):
        first[group] = min(name, first.get(group, name))
    return [first[group] for group in joined]


def _join_openings(names: Sequence[str], apart_mm: float) -> list[str]:
    """Names of openings (of `synth.job.identity`), with one name for those of a brain that overlap."""
    placed = sorted({name for name in names if " at " in name})
    if not placed:
        return list(names)
    brains, places = zip(*(name.split(" at ") for name in placed), strict=True)
    from scipy.sparse.csgraph import connected_components  # of brains of users alone
    from scipy.spatial.distance import cdist

    apart = cdist(*[np.array([place.split(",") for place in places], float)] * 2)
    same = np.array(brains)[:, None] == np.array(brains)
    part = connected_components(same & (apart < apart_mm))[1].tolist()
    joined = {name: placed[part.index(k)] for name, k in zip(placed, part, strict=True)}
    return [joined.get(name, name) for name in names]
