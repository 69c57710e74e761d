"""Intervals of means over sequences, whose frames are not independent."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats

from learn.evaluation.metrics import agreements
from synth.arrays import Array, Floats

LEAST_GROUPS = 5  # of fewer specimens a 95% interval would hardly exceed the range of their means
_DRAWS = 4000


def as_plain(value: Any, digits: int | None = None) -> Any:
    """A value as JSON can store it: numbers rounded to `digits` decimals, if given; NaN and infinity None."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(key): as_plain(part, digits) for key, part in value.items()}
    if isinstance(value, np.ndarray | np.integer):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [as_plain(part, digits) for part in value]
    if isinstance(value, float | np.floating):
        number = float(value) if digits is None else round(float(value), digits)
        return number if math.isfinite(value) else None
    return value


@dataclass(frozen=True)
class Interval:
    """A mean over sequences with its 95% interval."""

    mean: float
    low: float
    high: float
    n: int


def interval(values: Floats, rng: np.random.Generator, draws: int = _DRAWS) -> Interval:
    """Mean and BCa bootstrap interval (Efron 1987) over sequences (n,), NaN left out; any unit. The interval
    is NaN with fewer than three values, or if all are equal."""
    v = np.asarray(values, np.float64)
    return _bootstrap(np.mean, (v[np.isfinite(v)],), rng, draws)


def pooled_r2(moments: Floats, rng: np.random.Generator, draws: int = _DRAWS) -> Interval:
    """R² over the pooled values of n sequences, from their `moments` (n, 7), and its BCa interval over
    sequences; NaN with fewer than three."""

    def r2(*sums: Floats, axis: int) -> Floats:
        return agreements(np.stack([moment.sum(axis) for moment in sums], axis=-1))["r2"]

    return _bootstrap(r2, tuple(np.asarray(moments, np.float64).T), rng, draws)


def over_groups(
    values: Sequence[float] | Floats, groups: Sequence[str], rng: np.random.Generator
) -> Interval:
    """Mean over recordings, NaN left out, and its percentile interval, for which whole groups (specimens) are
    drawn; NaN with fewer than `LEAST_GROUPS`."""
    v = np.asarray(values, np.float64)
    is_finite = np.isfinite(v)
    group_indices = np.unique(np.asarray(groups)[is_finite], return_inverse=True)[1]
    sums, sizes = np.bincount(group_indices, v[is_finite]), np.bincount(group_indices)

    def mean(sums: Floats, sizes: Floats, axis: int) -> Floats:
        return np.asarray(sums.sum(axis) / sizes.sum(axis))

    return _bootstrap(mean, (sums, sizes), rng, _DRAWS, "percentile", LEAST_GROUPS)


def _bootstrap(
    statistic: Callable[..., Any],
    data: tuple[Array, ...],
    rng: np.random.Generator,
    draws: int,
    method: Literal["BCa", "percentile"] = "BCa",
    least: int = 3,
) -> Interval:
    """A statistic of (n,) columns and its interval; rows are resampled together."""
    low = high = float("nan")
    n = len(data[0])
    value = float(statistic(*data, axis=-1)) if n else low
    if n >= least and np.isfinite(value):
        with warnings.catch_warnings(), np.errstate(invalid="ignore"):
            warnings.simplefilter("ignore", stats.DegenerateDataWarning)  # equal values: NaN
            result = stats.bootstrap(
                data, statistic, paired=True, vectorized=True, n_resamples=draws, method=method, rng=rng
            ).confidence_interval
        low, high = float(result.low), float(result.high)
    return Interval(value, low, high, n)
