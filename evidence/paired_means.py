"""Means over sequences, and paired differences, with their 95% intervals, as lists for JSON."""

from collections.abc import Sequence

import numpy as np

from learn.evaluation.statistics import interval
from synth.arrays import Floats

Values = Sequence[float | None] | Floats  # one of each sequence; None or NaN: left out


def mean_of(values: Values, seed: int = 0) -> list[float]:
    """Mean, low and high (BCa bootstrap)."""
    found = interval(np.asarray(values, np.float64), np.random.default_rng(seed))
    return [found.mean, found.low, found.high]


def difference(usual: Values, other: Values, seed: int = 0) -> list[float]:
    """Mean, low and high of `other` less `usual` on the same sequences."""
    one, two = (np.asarray(values, np.float64) for values in (usual, other))
    return mean_of(two - one, seed)
