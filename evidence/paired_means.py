"""Means over sequences, and paired differences, with their 95% intervals, as lists for JSON."""

from collections.abc import Sequence

import numpy as np

from learn.evaluation.statistics import interval
from synth.arrays import Floats

Values = Sequence[float | None] | Floats  # one of each sequence; None or NaN: left out


def mean_of(values: Values, seed: int = 0) -> list[float]:
    """Mean, low and high (BCa bootstrap)."""
    estimate = interval(np.asarray(values, np.float64), np.random.default_rng(seed))
    return [estimate.mean, estimate.low, estimate.high]


def difference(base: Values, other: Values, seed: int = 0) -> list[float]:
    """Mean, low and high of `other` less `base` on the same sequences."""
    first, second = (np.asarray(values, np.float64) for values in (base, other))
    return mean_of(second - first, seed)
