"""Who may be trained on, who chooses the epoch, and who is asked at the end: never the same anatomy twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from learn.data import Clip
from synth.errors import UserError


@dataclass(frozen=True)
class Split:
    """Indices into the list of clips; the three share no sequence, no group and no held-out family."""

    fit: tuple[int, ...]
    select: tuple[int, ...]
    test: tuple[int, ...]


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
            f"{len(names)} different anatomies"
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
    """Fold `fold` is the test, the next one chooses the epoch, the others are fitted.

    With `held_out_family` the sequences of that appearance are the test and only the others are split.
    Raises UserError for fewer than three folds, a fold that doesn't exist, or an unknown family.
    """
    if held_out_family is not None:
        test = tuple(i for i, c in enumerate(clips) if c.family == held_out_family)
        if not test:
            known = ", ".join(sorted({c.family for c in clips}))
            raise UserError(f"no sequence of family {held_out_family!r} to hold out; there are: {known}")
        seen = set(np.array(groups(clips))[list(test)].tolist())
        rest = [i for i, g in enumerate(groups(clips)) if g not in seen]
        if count < 2:
            raise UserError(f"{count} folds: fitting and selecting need at least 2")
        parts = folds([clips[i] for i in rest], count, seed)
        picked = fold % count
        chosen = tuple(rest[i] for i in parts[picked])
        fit = tuple(rest[i] for k, p in enumerate(parts) if k != picked for i in p)
        return Split(fit, chosen, test)
    if count < 3:
        raise UserError(f"{count} folds: fit, select and test need at least 3")
    if not 0 <= fold < count:
        raise UserError(f"fold {fold}: there are folds 0 to {count - 1}")
    parts = folds(clips, count, seed)
    choose = (fold + 1) % count
    fit = tuple(i for k, p in enumerate(parts) if k not in (fold, choose) for i in p)
    return Split(tuple(sorted(fit)), parts[choose], parts[fold])
