"""Who is fitted, who chooses the epoch, and who is asked at the end: never the same anatomy twice.

Groups, and that none may be on two sides, are `synth.dataset.split`'s; a dataset that `synth split` has split
keeps that split.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from learn.data.clips import Clip
from synth.dataset.split import SIDES, draw_groups, join_groups
from synth.errors import UserError

_HINT = (
    "; share_anatomy=true, or `synth split --by opening`, splits one brain by its openings (`synth preview "
    "MESH` finds them, craniotomy.also lists them), or else by sequence, and says nothing of other brains"
)
_OPENINGS = 3  # fit, select and test
_SEQUENCE = "/"  # between the anatomy and the sequence in a group's name; in none of an anatomy or opening


@dataclass(frozen=True)
class Split:
    """Indices into the list of clips; the parts share no sequence, no group and no held-out family."""

    fit: tuple[int, ...]
    select: tuple[int, ...]
    test: tuple[int, ...]
    intervals: tuple[int, ...] = ()
    """Neither fitted nor chosen on, and no test: what intervals are fitted on."""


def ungrouped(clips: Sequence[Clip], *, by_opening: bool | None = None) -> list[Clip]:
    """The clips without their anatomies as groups: for a dataset of a single brain, whose sequences can't be
    kept apart by anatomy. Each place that the brain is opened at is a group, or else every sequence is; not
    told, the former where there are three or more. Scores then say nothing of other brains."""
    if by_opening is None:
        by_opening = len({c.opening for c in clips if c.opening}) >= _OPENINGS
    if by_opening:
        return [replace(c, group=c.opening or c.group) for c in clips]
    return [replace(c, group=f"{c.group}{_SEQUENCE}{c.content_hash}") for c in clips]


def are_openings(groups: Mapping[str, Sequence[str]]) -> bool:
    """Whether the groups of a model's card, of `ungrouped`, are openings and not sequences."""
    return not all(_SEQUENCE in name for part in groups.values() for name in part)


def groups(clips: Sequence[Clip]) -> list[int]:
    """A group number for each clip: equal where two share an anatomy or are the same sequence twice."""
    return join_groups([c.group for c in clips], [c.content_hash for c in clips])


def folds(clips: Sequence[Clip], count: int, seed: int) -> list[tuple[int, ...]]:
    """`count` sets of clips that share no group, of nearly equal size; the largest groups are dealt first.

    Raises UserError if there are more folds than groups.
    """
    number = groups(clips)
    anatomies = len(set(number))
    if not 2 <= count <= anatomies:
        raise UserError(
            f"{count} folds: 2 or more are needed, at most one for each anatomy, and {len(clips)} sequences "
            f"hold {anatomies} of them" + _advise(clips) * (anatomies < 3)
        )
    part = draw_groups(number, [1.0] * count, seed)
    return [tuple(i for i, k in enumerate(part) if k == fold) for fold in range(count)]


def nested(
    clips: Sequence[Clip], count: int, fold: int, seed: int, held_out_family: str | None = None
) -> Split:
    """Fold `fold` of `count` is the test; of the rest a fifth chooses the epoch and the others are fitted.

    With `held_out_family` the sequences of that appearance are the test instead, and `fold` only says which
    of the others choose. Raises UserError if a part would be empty, or for an unknown fold or family.
    """
    number = groups(clips)
    if held_out_family is None:
        if not 0 <= fold < count:
            raise UserError(f"fold {fold}: there are folds 0 to {count - 1}")
        test = folds(clips, count, seed)[fold]
    else:
        test = tuple(i for i, c in enumerate(clips) if c.family == held_out_family)
        if not test:
            known = ", ".join(sorted({c.family for c in clips}))
            raise UserError(f"no sequence of family {held_out_family!r} to hold out; there are: {known}")
    seen = {number[i] for i in test}
    rest = [i for i, g in enumerate(number) if g not in seen]
    select, fit = _choosers(clips, rest, seed, fold if held_out_family is not None else 0)
    return Split(fit, select, test)


def keep_written(clips: Sequence[Clip], sides: Mapping[str, str], seed: int) -> Split:
    """The split that the dataset came with: its train, validation and test are fit, select and test.

    `sides`: by content hash (`synth.dataset.index.written_sides`). Without a validation side, a fifth of the
    train side chooses the epoch. Raises UserError if too few are left to fit and choose.
    """
    train, validation, test = (
        tuple(i for i, c in enumerate(clips) if sides.get(c.content_hash) == side) for side in SIDES
    )
    if train and validation:
        return Split(train, validation, test)
    select, fit = _choosers(clips, train, seed, 0)
    return Split(fit, select, test)


def _advise(clips: Sequence[Clip]) -> str:
    """How to come to more groups."""
    alone = len(set(groups(clips))) == len(clips)
    return "; here each sequence is one: render more of them" if alone else _HINT


def _choosers(
    clips: Sequence[Clip], rest: Sequence[int], seed: int, part: int
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """A fifth of what is left beside the test, to choose the epoch, and the others, to fit."""
    number = groups(clips)
    left = len({number[i] for i in rest})
    if left < 2:
        raise UserError(
            f"fit, select and test need an anatomy each: {len(set(number))} are there, {left} are left of "
            "them beside the test" + _advise(clips)
        )
    parts = folds([clips[i] for i in rest], min(5, left), seed)
    select = tuple(rest[i] for i in parts[part % len(parts)])
    return select, tuple(i for i in rest if i not in select)
