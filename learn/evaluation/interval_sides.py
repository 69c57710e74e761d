"""Who intervals are fitted on: sequences that were neither fitted nor chosen on, and are no test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from learn.checkpoint import Card
from learn.data.clips import Clip
from learn.data.split import Split, groups
from learn.uncertainty import conformal
from learn.uncertainty.conformal import LEVELS

LEAST_CHOSEN = 3
"""Brains that the scale of the errors must be seen on."""


def keep_back(clips: Sequence[Clip], split: Split, seed: int) -> Split:
    """The split with half of the brains that choose the epoch kept for intervals instead.

    They are drawn, not dealt by size, so that they are like any brain to come. Where half would be too few
    for 90%, the split stays as it is.
    """
    number = groups(clips)
    names = np.unique([number[i] for i in split.select])
    if len(names) < 2 * conformal.least_units(LEVELS[0]):
        return split
    drawn = np.random.default_rng([seed, 0x1E7]).permutation(names)[: len(names) // 2]
    kept = tuple(i for i in split.select if number[i] in drawn)
    return replace(split, select=tuple(i for i in split.select if i not in kept), intervals=kept)


def find_obstacle(chosen: Sequence[Clip], kept: Sequence[Clip]) -> str:
    """Why there can be no intervals; empty if there can be.

    `chosen`: sequences that the scale is fitted on; `kept`: those that the factors come from.
    """
    least = conformal.least_units(LEVELS[0])
    parts = (
        ("kept for intervals", kept, least),
        ("left to choose the epoch, on which the scale of errors is fitted", chosen, LEAST_CHOSEN),
    )
    for what, part, needed in parts:
        found = len(set(groups(part)))
        if found < needed:
            return f"{found} brains are {what}; {LEVELS[0]:.0%} intervals need {needed}"
    return ""


def find_sides(clips: Sequence[Clip], card: Card, test: Sequence[str], from_test: bool) -> Split:
    """Who of a dataset's sequences a trained model's intervals are fitted on.

    Kept for it is what was already, else everything that the model has not met and that is no test; with
    `from_test` half of the brains of the test instead, drawn, and the other half stays it.

    Args:
        clips: of the dataset.
        test: content hashes of those marked test, beside the card's.
        from_test: whether test sequences may be taken.
    """
    side = {h: part for part, hashes in card.split.items() for h in hashes}
    met = {g for part in ("fit", "select") for g in card.groups.get(part, [])}
    tests = {*card.split.get("test", []), *test}
    fit_, select = (
        tuple(i for i, c in enumerate(clips) if side.get(c.content_hash) == part)
        for part in ("fit", "select")
    )
    already = tuple(i for i, c in enumerate(clips) if side.get(c.content_hash) == "intervals")
    new = [i for i, c in enumerate(clips) if c.content_hash not in side or c.content_hash in tests]
    new = [i for i in new if clips[i].group not in met]
    if from_test:
        mine = [i for i in new if clips[i].content_hash in tests]
        number = groups(clips)
        names = np.unique([number[i] for i in mine])
        drawn = set(np.random.default_rng(card.settings.seed).permutation(names)[: len(names) // 2].tolist())
        kept = tuple(i for i in mine if number[i] in drawn)
    else:
        kept = already or tuple(i for i in new if clips[i].content_hash not in tests)
    taken = {clips[i].content_hash for i in kept}
    return Split(fit_, select, tuple(i for i in new if clips[i].content_hash in tests - taken), kept)
