"""Who is fitted, who chooses the epoch, and who is asked at the end: the sides of a dataset's one split."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from learn.data.clips import Clip
from synth.dataset.split import join_groups

Unit = Literal["anatomy", "opening", "sequence"]
"""What is never on two sides."""
_SEQUENCE = "/"  # between the anatomy and the sequence in a group's name; in none of an anatomy or opening
_OPENING = " at "  # between the anatomy and the place


@dataclass(frozen=True)
class Split:
    """Indices into the list of clips; the parts share no sequence, no group and no held-out family."""

    fit: tuple[int, ...]
    select: tuple[int, ...]
    test: tuple[int, ...]
    intervals: tuple[int, ...] = ()
    """Neither fitted nor chosen on, and no test: what intervals are fitted on."""
    hashes: tuple[str, ...] = ()
    """Of the split of each dataset that this is made from."""


def regroup(clips: Sequence[Clip], unit: Unit) -> list[Clip]:
    """The clips with their anatomies, each place that these are opened at, or each sequence as groups.

    Two of one brain are then no strangers: scores say nothing of other brains.
    """
    if unit == "opening":
        return [replace(c, group=c.opening or c.group) for c in clips]
    if unit == "sequence":
        return [replace(c, group=f"{c.group}{_SEQUENCE}{c.content_hash}") for c in clips]
    return list(clips)


def find_unit(groups: Mapping[str, Sequence[str]]) -> Unit:
    """What the groups of a model's card are."""
    names = [name for part in groups.values() for name in part]
    if any(_SEQUENCE in name for name in names):
        return "sequence"
    return "opening" if any(_OPENING in name for name in names) else "anatomy"


def groups(clips: Sequence[Clip]) -> list[int]:
    """A group number for each clip: equal where two share an anatomy or are the same sequence twice."""
    return join_groups([c.group for c in clips], [c.content_hash for c in clips])
