"""Intervals beside what a network says: of the force and of its components.

Half of an interval's width is the expected size of the error (`ErrorModel`), times how far the frame is out
of distribution (`OutOfDistribution`, and a prediction above all that the error model was fitted on), times a
factor that makes the stated share of new sequences' frames lie within (`conformal.quantile`). All but the
factor is fitted on other sequences than the factor is, and the network on others again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from learn.uncertainty import conformal
from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.error_model import ErrorModel, fit_error_model
from learn.uncertainty.features import ANSWER, answer_features
from learn.uncertainty.out_of_distribution import OutOfDistribution
from synth.errors import UserError
from synth.job.types import Positive

Floats = NDArray[np.float64]

LEVEL = LEVELS[0]
"""What is given where only one is."""
_LEAST = 1e-3  # of the training data's force: no error is expected to be smaller


@dataclass(frozen=True)
class Prediction:
    """A network's prediction for the frames of one film, per unit stiffness, and what is known of them."""

    motion: Floats
    """(T, F) `motion_features`."""
    force: Floats
    """(T, 3) total force in camera axes [mN at 1 kPa]; of a network of sizes the size in x, the rest NaN."""
    magnitude: NDArray[np.float32]
    """(T, N, N) ≥ 0, the map [mN/mm² or mN, at 1 kPa]."""
    pitch_mm: float

    @property
    def size(self) -> Floats:
        """(T,) of the total force."""
        return np.asarray(np.sqrt(np.nansum(self.force**2, axis=1)))

    @property
    def centre(self) -> Floats:
        """(T, 3) the middle of the components' intervals: 0 where the network gives no direction."""
        directed = np.isfinite(self.force).all(axis=1, keepdims=True)
        return np.asarray(np.where(directed, self.force, 0.0))


@dataclass(frozen=True)
class Example:
    """One sequence whose truth is known, as intervals are fitted on it."""

    unit: int
    """Equal where sequences are not exchangeable: of one brain."""
    motion: Floats
    """(T, F)."""
    features: Floats
    """(T, G) of the frames' errors."""
    error: Floats
    """(T, 4) of the force's size and components, ≥ 0 [mN at 1 kPa]."""


@dataclass(frozen=True)
class Spread:
    """How large an error may be."""

    scale: ErrorModel
    factors: dict[str, Positive]
    """By level: what the scale is multiplied by."""

    def half(self, features: Floats, level: float) -> Floats:
        """(...,) half the width of the interval of `level`, before it is widened, for features (..., F)."""
        return self.scale.predict(features) * self.factors[str(level)]


@dataclass(frozen=True)
class Band:
    """Lower and upper ends, both in the unit of what they are of."""

    low: Floats
    """(T,) of the size."""
    high: Floats
    axes_low: Floats
    """(T, 3) of the components in camera axes."""
    axes_high: Floats

    def times(self, young_kpa: float) -> Band:
        """Of tissue so stiff [kPa], what this is per unit stiffness."""
        return Band(*(young_kpa * end for end in (self.low, self.high, self.axes_low, self.axes_high)))


@dataclass(frozen=True)
class Intervals:
    """What a model's card holds of them."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    features: tuple[str, ...]
    """Names of those of a frame that the scales go by."""
    force_unit: Positive
    """Training data's total force [mN at 1 kPa]."""
    size: Spread
    axes: tuple[Spread, Spread, Spread]
    world: OutOfDistribution
    source: str
    """Displacement that they hold for, as in `learn.data.clips.FIELDS`."""
    units: int
    """Exchangeable units that the factors come from: brains, or sequences where one brain is shared."""
    sequences: int
    """How many sequences those are."""

    def __post_init__(self) -> None:
        frame, count = len(self.features), len(self.features) - len(ANSWER)
        for spread in (self.size, *self.axes):
            rule = spread.scale
            if not len(rule.slopes) == len(rule.low) == len(rule.high) == frame:
                raise ValueError(f"a scale is not of {frame} features")
            if spread.factors.keys() != {str(level) for level in LEVELS}:
                raise ValueError(f"levels are not {', '.join(map(str, LEVELS))}")
        if [len(row) for row in (self.world.middle, *self.world.precision)] != [count] * (count + 1):
            raise ValueError(f"the world is not of {count} features")

    def bound(self, predicted: Prediction, level: float = LEVEL) -> Band:
        """Intervals of the force of frames, per unit stiffness. UserError for another level."""
        if str(level) not in self.size.factors:
            raise UserError(f"level {level:g}: the model has intervals of {', '.join(self.size.factors)}")
        features = frame_features(predicted, self.force_unit)
        wide = _widen(self.world, self.size.scale, predicted.motion, features)
        half = wide * self.size.half(features, level)
        axes = np.stack([wide * one.half(features, level) for one in self.axes], axis=1)
        low = np.maximum(predicted.size - half, 0.0)
        return Band(low, predicted.size + half, predicted.centre - axes, predicted.centre + axes)


def frame_features(predicted: Prediction, force_unit: float) -> Floats:
    """(T, F + 2) what the errors of frames are predicted from: motion, size and area of the answer."""
    answer = answer_features(predicted.size / force_unit, predicted.magnitude, predicted.pitch_mm**2)
    return np.concatenate([predicted.motion, answer], axis=1)


def make_example(predicted: Prediction, true: Floats, unit: int, force_unit: float) -> Example:
    """A sequence's errors; `true`: (T, 3) force per unit stiffness; `force_unit`: as of `Intervals`."""
    off = np.abs(np.linalg.norm(true, axis=1) - predicted.size)
    return Example(
        unit=unit,
        motion=predicted.motion,
        features=frame_features(predicted, force_unit),
        error=np.column_stack([off, np.abs(true - predicted.centre)]),
    )


def fit(
    selection: Sequence[Example],
    calibration: Sequence[Example],
    world: OutOfDistribution,
    names: tuple[str, ...],
    force_unit: float,
    source: str,
) -> Intervals:
    """Scales from `selection`, factors from `calibration`; arguments else as the fields of `Intervals`.

    The two share no unit, and neither one with what the network was fitted on. Raises UserError if
    `calibration` has fewer units than the highest level needs.
    """
    count, least = len({one.unit for one in calibration}), conformal.least_units(LEVELS[0])
    if count < least:
        raise UserError(f"{count} brains are kept for intervals; {LEVELS[0]:.0%} needs {least}")
    features = np.concatenate([one.features for one in selection])
    error = np.concatenate([one.error for one in selection])
    weight = np.concatenate([np.full(n, 1 / n) for n in (len(one.features) for one in selection)])
    models = [fit_error_model(features, e, weight, _LEAST * force_unit) for e in error.T]
    wide = [_widen(world, models[0], one.motion, one.features) for one in calibration]

    def spread(k: int) -> Spread:
        """The error model of the size (0) or a component, with its factors."""
        by_unit: dict[int, list[Floats]] = {}
        for one, w in zip(calibration, wide, strict=True):
            error = one.error[:, k] / (w * models[k].predict(one.features))
            by_unit.setdefault(one.unit, []).append(error)
        together = [np.concatenate(errors) for errors in by_unit.values()]
        factors = {str(level): max(conformal.quantile(together, level), 1e-9) for level in LEVELS}
        return Spread(models[k], factors)

    return Intervals(
        features=(*names, *ANSWER),
        force_unit=force_unit,
        size=spread(0),
        axes=(spread(1), spread(2), spread(3)),
        world=world,
        source=source,
        units=count,
        sequences=len(calibration),
    )


def _widen(world: OutOfDistribution, size: ErrorModel, motion: Floats, features: Floats) -> Floats:
    """(T,) how far beyond usual a frame is, times how far its answer is above all of the scale's."""
    place = len(features[0]) - len(ANSWER)
    beyond = np.exp(np.maximum(features[:, place] - size.high[place], 0.0))
    return world.widening(motion) * beyond
