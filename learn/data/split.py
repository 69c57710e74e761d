"""Who may be trained on, who chooses the epoch, and who is asked at the end: never the same anatomy twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from learn.data.clips import Clip
from synth.errors import UserError

_HINT = "; share_anatomy=true splits one brain's sequences, and says nothing of other brains"


@dataclass(frozen=True)
class Split:
    """Indices into the list of clips; the three share no sequence, no group and no held-out family."""

    fit: tuple[int, ...]
    select: tuple[int, ...]
    test: tuple[int, ...]


def ungrouped(clips: Sequence[Clip]) -> list[Clip]:
    """The clips with every sequence a group of its own: for a dataset of a single brain, whose sequences
    can't be
    kept apart by anatomy. Scores then say nothing of other brains."""
    return [replace(c, group=f"{c.group}/{c.content_hash}") for c in clips]


def groups(clips: Sequence[Clip]) -> list[int]:
    """A group number for each clip: equal where two share an anatomy or are the same sequence twice."""
    number: dict[str, int] = {}
    root: list[int] = []

    def find(i: int) -> int:
        while root[i] != i:
            i = root[i]
        return i

    out = []
    for clip in clips:
        seen = [find(number[key]) for key in (f"a{clip.group}", f"h{clip.content_hash}") if key in number]
        here = min(seen) if seen else len(root)
        if not seen:
            root.append(here)
        for other in seen:
            root[other] = here
        number[f"a{clip.group}"] = number[f"h{clip.content_hash}"] = here
        out.append(here)
    return [find(g) for g in out]


def folds(clips: Sequence[Clip], count: int, seed: int) -> list[tuple[int, ...]]:
    """`count` sets of clips that share no group, of nearly equal size; the largest groups are dealt first.

    Raises UserError if there are more folds than groups.
    """
    group = np.array(groups(clips))
    names = np.random.default_rng(seed).permutation(np.unique(group))
    if not 2 <= count <= len(names):
        raise UserError(
            f"{count} folds: between 2 and {len(names)} are possible, for {len(clips)} sequences hold "
            f"{len(names)} different anatomies" + _HINT * (len(names) < 3)
        )
    size = {int(g): int((group == g).sum()) for g in names}
    bins: list[list[int]] = [[] for _ in range(count)]
    for g in sorted(size, key=lambda g: -size[g]):
        fewest = min(bins, key=len)
        fewest.extend(int(i) for i in np.flatnonzero(group == g))
    return [tuple(sorted(b)) for b in bins]


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
    left = len({number[i] for i in rest})
    if left < 2:
        raise UserError(
            f"fit, select and test need an anatomy each: {len(set(number))} are there, {left} are left of "
            "them beside the test" + _HINT
        )
    parts = folds([clips[i] for i in rest], min(5, left), seed)
    chosen = fold % len(parts) if held_out_family is not None else 0
    select = tuple(rest[i] for i in parts[chosen])
    fit = tuple(sorted(rest[i] for k, part in enumerate(parts) if k != chosen for i in part))
    return Split(fit, select, test)
