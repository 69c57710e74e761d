"""Who may be trained on: the one split of a dataset, in which no group is on both sides."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args

import numpy as np
from pydantic import FiniteFloat, TypeAdapter, ValidationError
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from synth.dataset.folder import write_whole
from synth.errors import UserError
from synth.job import identity
from synth.system import checked_file
from synth.system.config_file import first_mistake

By = Literal["anatomy", "opening", "family", "gesture", "stiffness", "sequence"]
"""What must not be shared between the sides: `opening` is the place that a user's brain is opened at, else
the anatomy; `stiffness` splits at quantiles of Young's modulus."""

Side = Literal["train", "validation", "test"]
SIDES: tuple[Side, ...] = get_args(Side)
_CLASSES = 10
Group = TypeVar("Group", int, str)
NAME = "split.json"


@dataclass(frozen=True)
class DatasetSplit:
    """How a dataset is split, and the side of every sequence: all of `split.json`."""

    by: By = "anatomy"
    shares: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (0.7, 0.15, 0.15)
    held_out: tuple[str, ...] = ()
    share_anatomy: bool = False
    """Whether one brain may be on several sides: scores then say nothing of other brains."""
    apart_mm: FiniteFloat = 0.0
    """By opening: those of one brain that are nearer to each other show the same tissue, and are one."""
    sides: Mapping[str, Side] = field(default_factory=dict)
    """By content hash."""

    @property
    def hash(self) -> str:
        """Of who is on which side."""
        return hashlib.blake2b(identity.canonical(dict(self.sides)), digest_size=16).hexdigest()

    def find(self, names: Iterable[str], where: Path | str) -> list[Side]:
        """The sides of the sequences of a dataset by content hash; UserError if one has none."""
        found = [self.sides.get(name) for name in names]
        if lost := found.count(None):
            raise UserError(
                f"{where}: {lost} of its {len(found)} sequences have no side in {NAME}: `synth report` "
                "places those that came since, `synth split` splits all anew"
            )
        return [side for side in found if side]


def read_stored(root: Path) -> DatasetSplit:
    """What `split.json` of the dataset in `root` says; the default without sides if there is none.

    Raises:
        UserError: it is no split.
    """
    if not os.path.lexists(root / NAME):
        return DatasetSplit()
    found = checked_file.read_json(root / NAME)
    try:
        return TypeAdapter(DatasetSplit).validate_python(found)
    except ValidationError as error:
        raise UserError(f"{root / NAME}: is damaged ({first_mistake(error)})") from None


def store(root: Path, chosen: DatasetSplit) -> None:
    """Makes `chosen` the split of the dataset in `root`."""
    write_whole(root / NAME, json.dumps(asdict(chosen), indent=1) + "\n")


def parse_rule(
    by: str, shares: str, held_out: Sequence[str], share_anatomy: bool = False, apart_mm: float = 0.0
) -> DatasetSplit:
    """A split without sides from the words of a command line, UserError for what is none; by opening, a brain
    is shared."""
    if by not in get_args(By):
        raise UserError(f"by {by}: is not one of {', '.join(get_args(By))}")
    try:
        train, validation, test = (float(word) for word in shares.split(","))
    except ValueError:
        raise UserError(f"shares {shares}: three numbers are needed, as 0.7,0.15,0.15") from None
    shared = share_anatomy or by == "opening"
    return DatasetSplit(cast(By, by), (train, validation, test), tuple(held_out), shared, apart_mm)


def count(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Sequences on each side."""
    sides = [row.get("split") for row in rows]
    return {side: sides.count(side) for side in SIDES if side in sides}


def assign_sides(rows: Sequence[Mapping[str, Any]], chosen: DatasetSplit) -> list[Side | None]:
    """The side of every row of the index; None for a sequence that failed.

    Who has a side keeps it, and a group that has one gives it to who joins it; the groups that are left are
    dealt so that shares come near. Their sides depend on their names and on which groups there are, not on
    the order of rows. Sequences of a family that is held out are always for testing; any group that they
    share goes with them. Who would join groups of two sides has none.

    Raises:
        UserError: a family that is not there, shares that do not sum to 1, or fewer groups than sides.
    """
    by, shares = chosen.by, chosen.shares
    if len(shares) != 3 or not (abs(sum(shares) - 1) <= 1e-6 and min(shares) >= 0):  # NaN is neither
        raise UserError(f"shares {shares}: must not be negative and must sum to 1")
    done = [row for row in rows if row["status"] == "done"]
    unknown = set(chosen.held_out) - {str(row["family"]) for row in done}
    if unknown and not chosen.sides:
        raise UserError(f"family {', '.join(sorted(unknown))}: no sequence has it")
    if by == "stiffness" and any(row["young_kpa"] is None for row in done):
        raise UserError("by stiffness: a sequence says nothing of its Young's modulus")
    groups, kept = _groups(done, chosen), [chosen.sides.get(row["content_hash"]) for row in done]
    on: dict[str, set[int]] = {}
    for group, side, row in zip(groups, kept, done, strict=True):
        on.setdefault(group, set()).update([SIDES.index(side)] if side else [])
        on[group] |= {2} if row["family"] in chosen.held_out else set()
    fixed = {group: max(sides) for group, sides in on.items() if sides}
    needing = {k for k, share in enumerate(shares) if share > 0} - set(fixed.values())
    if len(on) - len(fixed) < len(needing) and not chosen.sides:
        hint = "render more sequences (`sequences` in the job)"
        if chosen.share_anatomy and by == "opening":
            hint = "craniotomy.also in the job lists further openings"
        elif len(on) < len(done) and not chosen.share_anatomy:
            hint += ", or split within a brain by `synth split --by opening` or --share-anatomy"
        wanted = sorted(needing | set(fixed.values()))
        each = ", ".join(SIDES[k] for k in wanted)
        few = f"{len(done)} sequences are {len(on)} groups by {by}, {len(wanted)} are needed"
        raise UserError(f"{few}, one each for {each}: {hint}")
    order = sorted(on, key=lambda name: hashlib.blake2b(name.encode(), digest_size=8).hexdigest())
    part = draw_groups(groups, shares, order, fixed)
    dealt = [SIDES[k] if len(on[group]) < 2 else None for group, k in zip(groups, part, strict=True)]
    sides = {row["index"]: old or new for row, old, new in zip(done, kept, dealt, strict=True)}
    return [sides.get(row["index"]) for row in rows]


def draw_groups(
    groups: Sequence[Group],
    shares: Sequence[float],
    order: Sequence[Group],
    fixed: Mapping[Group, int] | None = None,
) -> list[int]:
    """The part (0, 1, ...) of each member; no group is in two parts. Larger groups are dealt first.

    Args:
        groups: (N,) the group of each member.
        shares: of each part, in any unit; a part of share 0 gets nothing.
        order: of groups of one size.
        fixed: parts of groups that aren't drawn.
    """
    size = Counter(groups)
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


def assign_if_possible(rows: Sequence[Mapping[str, Any]], chosen: DatasetSplit) -> list[Side | None]:
    """`assign_sides`; no sides where there are too few groups to have some on each."""
    try:
        return assign_sides(rows, chosen)
    except UserError:
        return [None] * len(rows)


def misplaced(rows: Sequence[Mapping[str, Any]], chosen: DatasetSplit) -> list[str]:
    """Sequences that the index puts on another side than the split does, or on none beside others."""
    return [
        f"sequence {row['index']} is in {row['split']}, by the split in {side}"
        for row, side in zip(rows, assign_if_possible(rows, chosen), strict=True)
        if row["split"] != side or (chosen.sides and row["status"] == "done" and side is None)
    ]


def leaks(rows: Sequence[Mapping[str, Any]], chosen: DatasetSplit | None = None) -> list[str]:
    """Anatomies and contents that are on more than one side, and held-out families that are trained on."""
    chosen = chosen or DatasetSplit()
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
    count, known, first = len(keys[0]), dict[Hashable, int](), dict[int, int]()
    held = [(which, value) for which, values in enumerate(keys) for value in values]
    by = [count + known.setdefault(one, len(known)) for one in held]
    size = count + len(known)
    joined = coo_array((np.ones(len(by)), (np.arange(len(by)) % max(count, 1), by)), shape=(size, size))
    part = connected_components(joined, directed=False)[1][:count]
    return [first.setdefault(group, i) for i, group in enumerate(part.tolist())]


def name_anatomy(attrs: Mapping[str, Any]) -> str:
    """The name of a sequence's anatomy across datasets; a sequence that states none has one of its own. All
    sequences of one user's brain are one anatomy."""
    return str(attrs.get("anatomy_id") or attrs["content_hash"])


def _groups(rows: Sequence[Mapping[str, Any]], chosen: DatasetSplit) -> list[str]:
    """A group's name for every row; groups that share an anatomy are one unless the rule allows it."""
    if chosen.by == "stiffness":
        ordered = sorted(float(row["young_kpa"]) for row in rows)
        edges = [ordered[k * len(ordered) // _CLASSES] for k in range(1, _CLASSES)]
        names = [f"E{sum(row['young_kpa'] >= edge for edge in edges)}" for row in rows]
    elif chosen.by == "opening":
        names = _join_openings([str(row.get("opening") or row["anatomy"]) for row in rows], chosen.apart_mm)
    else:
        names = [str(row["content_hash" if chosen.by == "sequence" else chosen.by]) for row in rows]
    if chosen.share_anatomy:
        return names
    joined, first = join_groups(names, [row["anatomy"] for row in rows]), dict[int, str]()
    for group, name in zip(joined, names, strict=True):
        first[group] = min(name, first.get(group, name))
    return [first[group] for group in joined]


def _join_openings(names: Sequence[str], apart_mm: float) -> list[str]:
    """The openings of a brain that overlap under one name; `names`: as `synth.job.identity` makes them.

    A procedural brain, which is opened at one place, and stores that don't say where, come as an anatomy.
    """
    placed = sorted({name for name in names if " at " in name})
    if not placed:
        return list(names)
    brains, places = zip(*(name.split(" at ") for name in placed), strict=True)
    apart = cdist(*[np.array([place.split(",") for place in places], float)] * 2)
    same = np.array(brains)[:, None] == np.array(brains)
    part = connected_components(same & (apart < apart_mm))[1].tolist()
    joined = {name: placed[part.index(k)] for name, k in zip(placed, part, strict=True)}
    return [joined.get(name, name) for name in names]
