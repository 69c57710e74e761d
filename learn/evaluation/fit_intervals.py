"""Fitting of a model's prediction intervals on sequences of known force, into its card."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from learn.checkpoint import ModelCard, write_card
from learn.data.clips import Clip, scored_source
from learn.inference.predict import Predictor, length, net_force
from learn.split import Split, find_obstacle, groups
from learn.uncertainty.features import motion_features, motion_names
from learn.uncertainty.intervals import Intervals, Prediction, fit, make_example
from learn.uncertainty.out_of_distribution import fit_distribution
from synth.arrays import Floats
from synth.errors import UserError
from synth.system.terminal import ProgressCallback

_MOST_FITTED = 500  # training sequences that the distribution of motion is fitted on


def add_intervals(
    folder: Path,
    predictor: Predictor,
    clips: Sequence[Clip],
    split: Split,
    report: ProgressCallback = lambda done, of: None,
) -> ModelCard:
    """Fits intervals and writes them, or why there are none, into a model's card, which is returned.

    Of `clips`, `split.fit` is for the distribution of motion, `select` for the error model, `intervals` for
    the factors. UserError if nothing moves.
    """
    selection, calibration = ([clips[i] for i in part] for part in (split.select, split.intervals))
    obstacle, intervals = find_obstacle(selection, calibration), None
    if not obstacle:
        source = scored_source(predictor.card.settings.input)
        fitted = [clips[i] for i in split.fit if source in clips[i].displacement]
        intervals = _fit(predictor, (fitted, selection, calibration), source, report)
    card = replace(predictor.card, intervals=intervals, no_intervals=obstacle)
    write_card(folder, card)
    return card


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
    sample = [fitted[i] for i in rng.permutation(len(fitted))[:_MOST_FITTED]]
    motion = [_features(clip, source, card.settings.extent_mm) for clip in sample]
    first, second = examples[: len(selection)], examples[len(selection) :]
    distribution = fit_distribution(motion, [example.motion for example in first])
    if distribution is None:
        raise UserError("nothing moves in the sequences that the intervals are to be fitted on")
    # A recording's distance doesn't depend on errors: all sequences but the training ones count.
    distribution = distribution.calibrate([example.motion for example in examples])
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
