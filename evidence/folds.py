"""Cross-validation of an experiment's own: folds that share no anatomy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from learn.data.clips import Clip
from learn.split import Split, groups
from synth.dataset.split import draw_groups


def folds(clips: Sequence[Clip], count: int, seed: int) -> list[tuple[int, ...]]:
    """`count` sets of clips that share no group, of nearly equal size; the largest groups are dealt first."""
    number = groups(clips)
    order = np.random.default_rng(seed).permutation(sorted(set(number))).tolist()
    part = draw_groups(number, [1.0] * count, order)
    return [tuple(i for i, k in enumerate(part) if k == fold) for fold in range(count)]


def nested(clips: Sequence[Clip], count: int, fold: int, seed: int) -> Split:
    """Fold `fold` of `count` is the test; of the rest a fifth chooses the epoch and the others are fitted."""
    test = folds(clips, count, seed)[fold]
    rest = [i for i in range(len(clips)) if i not in set(test)]
    inner = [clips[i] for i in rest]
    chosen = folds(inner, min(5, len(set(groups(inner)))), seed)[0]
    select = tuple(rest[k] for k in chosen)
    return Split(tuple(i for i in rest if i not in select), select, test)
