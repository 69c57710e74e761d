"""A model's intervals fitted on sequences of known truth, and written into its card."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from learn.checkpoint import ModelCard, write_card
from learn.data.clips import Clip, scored
from learn.inference.predict import Predictor, length, net_force
from learn.split import Split, find_obstacle, find_sides, find_unit, groups, regroup
from learn.uncertainty.features import motion_features, motion_names
from learn.uncertainty.intervals import Intervals, Prediction, fit, make_example
from learn.uncertainty.out_of_distribution import fit_distribution
from synth.dataset.index import read_split
from synth.errors import UserError
from synth.system.terminal import ProgressCallback

_MOST_FITTED = 500  # sequences that the distance is measured from


def add_intervals(
    folder: Path,
    predictor: Predictor,
    clips: Sequence[Clip],
    split: Split,
    source: str | None = None,
    report: ProgressCallback = lambda done, of: None,
) -> ModelCard:
    """Fits intervals and writes them, or why there are none, into the card of a model's folder; that card.

    Whoever of `split.select` did not choose the epoch counts as kept for intervals from then on.

    Args:
        folder: of the model.
        predictor: the model.
        clips: sequences of known truth.
        split: `fit`: what the network was fitted on, from which a frame's distance is measured; `select` and
            `intervals`: what the error model and the factors are fitted on.
        source: displacement that the intervals hold for; None: the one that the model is scored on.
        report: told how many sequences are done, and how many there are.

    Raises:
        UserError: nothing moves in the sequences.
    """
    parts = split.fit, split.select, split.intervals
    fitted, selection, calibration = ([clips[i] for i in part] for part in parts)
    why, found = find_obstacle(selection, calibration), None
    if not why:
        source = source or scored(predictor.card.settings.input)
        found = _fit(predictor, fitted, selection, calibration, source, report)
    choosers = set(predictor.card.groups.get("select", ()))
    used = [*calibration, *(clip for clip in selection if calibration and clip.group not in choosers)]
    taken = {clip.content_hash for clip in used}, {clip.group for clip in used}
    hashes, brains = (
        {part: [one for one in names if one not in gone] for part, names in parts.items()}
        for parts, gone in zip((predictor.card.split, predictor.card.groups), taken, strict=True)
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
    report: ProgressCallback = lambda done, of: None,
) -> Intervals:
    """Fits intervals of a trained model on the sequences of some datasets, into its card.

    Args:
        folder: of the model.
        predictor: the model.
        clips: all sequences of the datasets.
        datasets: where they came from: the training data, and any that the model never met.
        source: displacement that the intervals hold for.
        from_test: whether half of the test's brains may be taken.
        report: told how many sequences are done, and how many there are.

    Raises:
        UserError: none of the sequences was fitted, or there are too few of others.
    """
    clips = regroup(clips, find_unit(predictor.card))
    marked = [read_split(one, required=False).sides.items() for one in datasets]
    tests = [name for part in marked for name, side in part if side == "test"]
    split = find_sides(clips, predictor.card, tests, from_test)
    if not split.fit:
        raise UserError(
            f"{datasets[0]}: holds no sequence that {folder} was fitted on; name its training data"
        )
    why = find_obstacle([clips[i] for i in split.select], [clips[i] for i in split.intervals])
    if why:
        hint = "" if from_test else "; name a dataset that it never met, or say --from-test"
        raise UserError(f"{folder}: {why}{hint}")
    found = add_intervals(folder, predictor, clips, split, source, report).intervals
    assert found is not None
    return found


def _fit(
    predictor: Predictor,
    fitted: Sequence[Clip],
    selection: Sequence[Clip],
    calibration: Sequence[Clip],
    source: str,
    report: ProgressCallback,
) -> Intervals:
    """Intervals from the parts of `add_intervals`' split."""
    card = predictor.card
    unit, rng = card.scales.force, np.random.default_rng(card.settings.seed)
    brains, examples = [0] * len(selection) + groups(calibration), []
    for k, (clip, brain) in enumerate(zip([*selection, *calibration], brains, strict=True)):
        report(k, len(brains))
        true = clip.force / clip.young_kpa
        examples.append(make_example(predict_clip(predictor, clip, source), true, brain, unit))
    report(len(brains), len(brains))
    some = [fitted[i] for i in rng.permutation(len(fitted))[:_MOST_FITTED]]
    motion = [
        motion_features(np.asarray(c.displacement[source]), c.mask, c.sure(source), card.settings.extent_mm)
        for c in some
    ]
    first, second = examples[: len(selection)], examples[len(selection) :]
    world = fit_distribution(motion, [one.motion for one in first])
    if world is None:
        raise UserError("nothing moves in the sequences that the intervals are to be fitted on")
    # No error says how far a recording is: all that were not fitted count.
    world = world.calibrated([one.motion for one in examples])
    return fit(first, second, world, motion_names(card.settings.arch.depth), unit, source)


def predict_clip(predictor: Predictor, clip: Clip, source: str) -> Prediction:
    """A sequence's forces per unit stiffness; no motion is no force, as to `ForceEstimator`."""
    shift, mask, grid = np.asarray(clip.displacement[source]), clip.mask, predictor.grid
    sure, young = clip.sure(source), clip.young_kpa
    kind = predictor.card.settings.target
    density = predictor.density(shift, mask, young, sure)
    at_rest = predictor.density(np.zeros_like(shift[:1]), mask, young)
    return Prediction(
        motion=motion_features(shift, mask, sure, grid.extent_mm),
        force=net_force(density, at_rest, kind, grid) / young,
        magnitude=length(density) / np.float32(young),
        pitch_mm=grid.pitch_mm,
    )
