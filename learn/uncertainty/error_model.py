"""Expected size of an error, from features that don't need the true force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import FiniteFloat

from synth.arrays import Floats
from synth.job.types import Positive


@dataclass(frozen=True)
class ErrorModel:
    """A log-linear model of the error's size, constant beyond the range of the fitted features."""

    intercept: FiniteFloat
    slopes: tuple[FiniteFloat, ...]
    low: tuple[FiniteFloat, ...]  # smallest fitted value of each feature
    high: tuple[FiniteFloat, ...]  # largest
    least: Positive  # lower limit of the expected error, in its unit

    def predict(self, features: Floats) -> Floats:
        """Expected errors (...,), > 0, for features (..., F)."""
        clipped = np.clip(features, self.low, self.high)
        return np.asarray(np.maximum(np.exp(self.intercept + clipped @ np.array(self.slopes)), self.least))


def fit_error_model(
    features: Floats, error: Floats, weight: Floats, least: float, ridge: float = 1.0
) -> ErrorModel:
    """Least squares on the logarithm of the error, regularised; by default slightly.

    `features`: (n, F); `error`: (n,) ≥ 0; `weight`: (n,) > 0; `least` > 0: added to an error, in its unit;
    `ridge`: number of frames as which the prior counts that a feature has no effect.
    """
    spread = np.maximum(features.std(0), 1e-6)
    log_error, share = np.log(error + least), weight / weight.mean()
    middle, level = np.average(features, 0, share), float(np.average(log_error, weights=share))
    scaled = (features - middle) / spread
    normal = scaled.T @ (share[:, None] * scaled) + ridge * np.eye(scaled.shape[1])
    slopes = np.linalg.solve(normal, scaled.T @ (share * (log_error - level))) / spread
    ends = slopes, features.min(0), features.max(0)
    per_feature, low, high = (tuple(end.tolist()) for end in ends)
    return ErrorModel(level - float(middle @ slopes), per_feature, low, high, least)
