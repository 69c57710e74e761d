"""Fitting of a model's prediction intervals on sequences of known force, into its card."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from learn.checkpoint import ModelCard, write_card
from learn.data.clips import Clip, scored_source
from learn.inference.predict import Predictor, length, net_force
from learn.split import Split, find_obstacle, find_sides, find_unit, groups, regroup
from learn.uncertainty.features import motion_features, motion_names
from learn.uncertainty.intervals import Intervals, Prediction, fit, make_example
from learn.uncertainty.out_of_distribution import fit_distribution
from synth.arrays import Floats
from synth.dataset.index import read_split
from synth.errors import UserError
from synth.system.terminal import ProgressCallback

_MOST_FITTED = 500  # training sequences that the distribution of motion is fitted on


def add_intervals(
    folder: Path,
    predictor: Predictor,
    clips: Sequence[Clip],
    split: Split,
    source: str | None = None,
    report: ProgressCallback = lambda done, of: None,
) -> ModelCard:
    """Fits intervals and writes them, or why there are none, into a model's card, which is returned.

    Of `clips`, `split.fit` is for the distribution of motion, `select` for the error model, `intervals` for
    the factors. Sequences of `select` that did not choose the epoch count as used for intervals from then on.
    `source`: displacement that the intervals are for; None: the scored one. UserError if nothing moves.
    """
    parts = split.fit, split.select, split.intervals
    fitted, selection, calibration = ([clips[i] for i in part] for part in parts)
    why, found = find_obstacle(selection, calibration), None
    if not why:
        source = source or scored_source(predictor.card.settings.input)
        found = _fit(predictor, (fitted, selection, calibration), source, report)
    choosers = set(predictor.card.groups.get("select", ()))
    used = [*calibration, *(clip for clip in selection if calibration and clip.group not in choosers)]
    taken = {clip.content_hash for clip in used}, {clip.group for clip in used}
    hashes, brains = (
        {part: [one for one in names if one not in moved] for part, names in parts.items()}
        for parts, moved in zip((predictor.card.split, predictor.card.groups), taken, strict=True)
    )
    if used:
        hashes["intervals"] = [clip.content_hash for clip in used]
        brains["intervals"] = sorted(taken[1])
    card = replace(predictor.card, intervals=found, no_intervals=why, split=hashes, groups=brains)
    write_card(folder, card)
    return card


def fit_from_datasets(
    folder: Path,
    predictor: Predictor,
    clips: Sequence[Clip],
    datasets: Sequence[Path],
    source: str,
    from_test: bool,
    report: ProgressCallback,
) -> Intervals:
    """Fits a trained model's intervals on all sequences `clips` of some `datasets`, into its card.

    `datasets`: the training data, and any new to the model; `from_test`: whether to use half of the test
    brains; others as of `add_intervals`. UserError without a training sequence, or with too few others.
    """
    clips = regroup(clips, find_unit(predictor.card))
    marked = [read_split(one, required=False).sides.items() for one in datasets]
    tests = [name for part in marked for name, side in part if side == "test"]
    split = find_sides(clips, predictor.card, tests, from_test)
    if not split.fit:
        raise UserError(f"{datasets[0]}: holds no training sequence of {folder}; add its training dataset")
    if why := find_obstacle([clips[i] for i in split.select], [clips[i] for i in split.intervals]):
        hint = "" if from_test else "; add a dataset that is new to it, or use --from-test"
        raise UserError(f"{folder}: {why}{hint}")
    found = add_intervals(folder, predictor, clips, split, source, report).intervals
    assert found is not None
    return found


def _fit(
    predictor: Predictor, parts: Sequence[Sequence[Clip]], source: str, report: ProgressCallback
) -> Intervals:
    """`parts`: as of `add_intervals`, for the distribution, the error model and the factors."""
    card, (fitted, selection, calibration) = predictor.card, parts
    unit, rng = card.scales.force, np.random.default_rng(card.settings.seed)
    brains, examples = [0] * len(selection) + groups(calibration), []
    for k, (clip, brain) in enumerate(zip([*selection, *calibration], brains, strict=True)):
        report(k, len(brains))
        true = clip.force / clip.young_kpa
        examples.append(make_example(predict_clip(predictor, clip, source), true, brain, unit))
    report(len(brains), len(brains))
    some = [fitted[i] for i in rng.permutation(len(fitted))[:_MOST_FITTED]]
    motion = [_features(clip, source, card.settings.extent_mm) for clip in some]
    first, second = examples[: len(selection)], examples[len(selection) :]
    distribution = fit_distribution(motion, [one.motion for one in first])
    if distribution is None:
        raise UserError("nothing moves in the sequences that the intervals are to be fitted on")
    # A recording's distance doesn't depend on errors: all sequences but the training ones count.
    distribution = distribution.calibrated([one.motion for one in examples])
    return fit(first, second, distribution, motion_names(card.settings.arch.depth), unit, source)


def predict_clip(predictor: Predictor, clip: Clip, source: str) -> Prediction:
    """A sequence's forces per unit stiffness, the estimate at rest subtracted as in `ForceEstimator`."""
    shift, mask, grid = np.asarray(clip.displacement[source]), clip.mask, predictor.grid
    young = clip.young_kpa
    density = predictor.density(shift, mask, young, clip.confidence_of(source))
    force = net_force(density, predictor.density(np.zeros_like(shift[:1]), mask, young), grid) / young
    motion = _features(clip, source, grid.extent_mm)
    return Prediction(motion, force, length(density) / np.float32(young), grid.pitch_mm)


def _features(clip: Clip, source: str, extent_mm: float) -> Floats:
    return motion_features(clip.displacement[source], clip.mask, clip.confidence_of(source), extent_mm)
