"""Prediction intervals of a network's force: of its size and its components.

Half their width is the expected size of the error (`ErrorModel`), times a widening for frames out of
distribution and for estimates above those of the error model's fit, times a factor that gives the stated
coverage (`conformal.quantile`). Network, error model and factor are fitted on different sequences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ConfigDict

from learn.uncertainty import conformal
from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.error_model import ErrorModel, fit_error_model
from learn.uncertainty.features import ESTIMATE, estimate_features
from learn.uncertainty.out_of_distribution import MotionDistribution
from synth.arrays import Floats, Map
from synth.errors import UserError
from synth.job.types import Positive

LEVEL = LEVELS[0]  # reported where there is one interval only
_LEAST = 1e-3  # lower limit of the expected error, as a share of the training data's force


@dataclass(frozen=True)
class Prediction:
    """A network's prediction for the frames of one video, per unit stiffness."""

    motion: Floats  # (T, F) `motion_features`
    force: Floats
    """(T, 3) total force in camera axes [mN at 1 kPa]; without direction the size in x, else NaN."""
    magnitude: Map  # (T, N, N) ≥ 0, the map [mN/mm² or mN, at 1 kPa]
    pitch_mm: float

    @property
    def size(self) -> Floats:
        """(T,) size of the total force."""
        return np.asarray(np.sqrt(np.nansum(self.force**2, axis=1)))

    @property
    def centre(self) -> Floats:
        """(T, 3) centres of the components' intervals: 0 without direction."""
        directed = np.isfinite(self.force).all(axis=1, keepdims=True)
        return np.asarray(np.where(directed, self.force, 0.0))


@dataclass(frozen=True)
class Example:
    """One sequence of known force, for fitting intervals."""

    unit: int  # equal for sequences of one brain, which are not exchangeable
    motion: Floats  # (T, F) `motion_features`
    features: Floats  # (T, G) `frame_features`
    error: Floats  # (T, 4) of the force's size and components, ≥ 0 [mN at 1 kPa]


@dataclass(frozen=True)
class Spread:
    """Width of the intervals of one quantity."""

    scale: ErrorModel
    factors: dict[str, Positive]  # on the scale, by level

    def half(self, features: Floats, level: float) -> Floats:
        """(...,) half the width of the interval of `level` before widening, for features (..., F)."""
        return self.scale.predict(features) * self.factors[str(level)]


@dataclass(frozen=True)
class Band:
    """Lower and upper ends of a force's intervals."""

    low: Floats  # (T,) of the size
    high: Floats
    axes_low: Floats  # (T, 3) of the components in camera axes
    axes_high: Floats

    def times(self, young_kpa: float) -> Band:
        """The ends for tissue of this E [kPa], of ends per unit stiffness."""
        return Band(*(young_kpa * end for end in (self.low, self.high, self.axes_low, self.axes_high)))


@dataclass(frozen=True)
class Intervals:
    """The prediction intervals of a model, stored in its card."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    features: tuple[str, ...]  # names of `frame_features`
    force_unit: Positive  # the training data's total force [mN at 1 kPa]
    size: Spread
    axes: tuple[Spread, Spread, Spread]
    distribution: MotionDistribution
    source: str  # displacement that they are for, as in `learn.data.clips.FIELDS`
    units: int  # exchangeable units in the calibration: brains, or sequences if a brain is on several sides
    sequences: int  # in the calibration

    def __post_init__(self) -> None:
        """Raises ValueError for a card whose arrays don't fit together."""
        frame, count = len(self.features), len(self.features) - len(ESTIMATE)
        for spread in (self.size, *self.axes):
            if {len(spread.scale.slopes), len(spread.scale.low), len(spread.scale.high)} != {frame}:
                raise ValueError(f"an error model doesn't have {frame} features")
            if spread.factors.keys() != {str(level) for level in LEVELS}:
                raise ValueError(f"levels are not {', '.join(map(str, LEVELS))}")
        rows = self.distribution.mean, *self.distribution.precision
        if [len(row) for row in rows] != [count] * (count + 1):
            raise ValueError(f"the distribution doesn't have {count} features")

    def bound(self, predicted: Prediction, level: float = LEVEL) -> Band:
        """Intervals of the frames' forces at a level of `LEVELS`, per unit stiffness."""
        features = frame_features(predicted, self.force_unit)
        widening = _widen(self.distribution, self.size.scale, predicted.motion, features)
        half = widening * self.size.half(features, level)
        axes = np.stack([widening * spread.half(features, level) for spread in self.axes], axis=1)
        low = np.maximum(predicted.size - half, 0.0)
        return Band(low, predicted.size + half, predicted.centre - axes, predicted.centre + axes)


def frame_features(predicted: Prediction, force_unit: float) -> Floats:
    """Features of the error model, (T, F + 2): of the motion and of the force estimate."""
    estimate = estimate_features(predicted.size / force_unit, predicted.magnitude, predicted.pitch_mm**2)
    return np.concatenate([predicted.motion, estimate], axis=1)


def make_example(predicted: Prediction, true: Floats, unit: int, force_unit: float) -> Example:
    """A sequence's errors. `true`: (T, 3) force per unit stiffness; `force_unit`: as of `Intervals`."""
    size_error = np.abs(np.linalg.norm(true, axis=1) - predicted.size)
    error = np.column_stack([size_error, np.abs(true - predicted.centre)])
    return Example(unit, predicted.motion, frame_features(predicted, force_unit), error)


def fit(
    selection: Sequence[Example],
    calibration: Sequence[Example],
    distribution: MotionDistribution,
    names: tuple[str, ...],
    force_unit: float,
    source: str,
) -> Intervals:
    """Fits error models on `selection` and factors on `calibration`; other arguments as in `Intervals`.

    The two and the training sequences must not share units. UserError for too few of `calibration`.
    """
    count, least = len({example.unit for example in calibration}), conformal.least_units(LEVELS[0])
    if count < least:
        raise UserError(f"{count} brains are left for intervals; {LEVELS[0]:.0%} needs {least}")
    features = np.concatenate([example.features for example in selection])
    error = np.concatenate([example.error for example in selection])
    weight = np.concatenate([np.full(n, 1 / n) for n in (len(example.features) for example in selection)])
    models = [fit_error_model(features, e, weight, _LEAST * force_unit) for e in error.T]
    widenings = [_widen(distribution, models[0], example.motion, example.features) for example in calibration]

    def spread(k: int) -> Spread:
        """Of the size (0) or of a component (1 to 3)."""
        by_unit: dict[int, list[Floats]] = {}
        for example, w in zip(calibration, widenings, strict=True):
            error = example.error[:, k] / (w * models[k].predict(example.features))
            by_unit.setdefault(example.unit, []).append(error)
        scores = [np.concatenate(errors) for errors in by_unit.values()]
        factors = {str(level): max(conformal.quantile(scores, level), 1e-9) for level in LEVELS}
        return Spread(models[k], factors)

    size, axes, feature_names = spread(0), (spread(1), spread(2), spread(3)), (*names, *ESTIMATE)
    return Intervals(feature_names, force_unit, size, axes, distribution, source, count, len(calibration))


def _widen(distribution: MotionDistribution, size: ErrorModel, motion: Floats, features: Floats) -> Floats:
    """(T,) factor on the width of intervals, for distant motion and for sizes above the fitted ones."""
    log_size = len(features[0]) - len(ESTIMATE)
    above = np.exp(np.maximum(features[:, log_size] - size.high[log_size], 0.0))
    return np.maximum(distribution.relative_distance(motion), 1.0) * above
