"""Who intervals are fitted on: sequences that were neither fitted nor chosen on, and are no test."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from learn.checkpoint import ModelCard
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
    calibration = tuple(i for i in split.select if number[i] in drawn)
    select = tuple(i for i in split.select if i not in calibration)
    return replace(split, select=select, intervals=calibration)


def find_obstacle(selection: Sequence[Clip], calibration: Sequence[Clip]) -> str:
    """Why there can be no intervals; empty if there can be.

    `selection`: sequences that the scale is fitted on; `calibration`: those that the factors come from.
    """
    least = conformal.least_units(LEVELS[0])
    parts = (
        ("kept for intervals", calibration, least),
        ("left to choose the epoch, on which the scale of errors is fitted", selection, LEAST_CHOSEN),
    )
    for what, part, needed in parts:
        found = len(set(groups(part)))
        if found < needed:
            brains = "brain is" if found == 1 else "brains are"
            return (
                f"{found} {brains} {what}; {LEVELS[0]:.0%} intervals need {needed}: of {2 * least} or more "
                "on the validation side half are kept (more sequences, or `synth split --shares`)"
            )
    return ""


def find_sides(clips: Sequence[Clip], card: ModelCard, test: Collection[str], from_test: bool) -> Split:
    """Who of a dataset's sequences a trained model's intervals are fitted on, brain by brain.

    Kept for it is what was already; else every brain that the model has not met and that has no test
    sequence; with `from_test` half of the brains of the test instead, drawn, and the other half stays it.
    Where too few brains chose the epoch, those that the error model still lacks are drawn from these.

    Args:
        clips: of the dataset.
        card: of the model.
        test: content hashes of those marked test, beside the card's.
        from_test: whether test sequences may be taken.
    """
    number = groups(clips)

    def brains(part: str, more: Collection[str] = ()) -> set[int]:
        hashes, names = {*card.split.get(part, ()), *more}, set(card.groups.get(part, ()))
        return {number[i] for i, c in enumerate(clips) if c.content_hash in hashes or c.group in names}

    def of(chosen: Collection[int]) -> tuple[int, ...]:
        return tuple(i for i in range(len(clips)) if number[i] in chosen)

    rng = np.random.default_rng(card.settings.seed)
    fitted, chosen = brains("fit"), brains("select")
    calibration, tests = brains("intervals") - fitted - chosen, brains("test", test) - fitted - chosen
    if from_test:
        drawn = rng.permutation(sorted(tests))
        calibration = {int(brain) for brain in drawn[: len(tests) // 2]}
    elif not calibration:
        calibration = set(number) - fitted - chosen - tests
    left, lacking = tests - calibration, max(LEAST_CHOSEN - len(chosen), 0)
    if len(calibration) >= conformal.least_units(LEVELS[0]) + lacking:
        lent = {int(brain) for brain in rng.permutation(sorted(calibration))[:lacking]}
        chosen, calibration = chosen | lent, calibration - lent
    return Split(of(fitted), of(chosen), of(left), of(calibration))
