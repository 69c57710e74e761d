"""Intervals for scores of curves whose samples depend on their neighbours, and of several recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Curve = NDArray[np.float64]
Interval = tuple[float, float]

RESAMPLES = 1000
LEVEL = 0.95
LEAST_GROUPS = 5
"""Of fewer, a 95% interval is little more than the two that are furthest apart."""


def block_length(x: Curve) -> float:
    """Mean block length for the stationary bootstrap of the mean of `x`, in samples.

    Politis and White, "Automatic block-length selection for the dependent bootstrap" (Econometric Reviews
    2004), with the correction of Patton, Politis and White (2009).

    Args:
        x: (T,) finite.
    """
    n = len(x)
    centred = x - x.mean()
    variance = float(centred @ centred) / n
    if n < 8 or variance == 0:
        return 1.0
    most = min(n - 1, int(np.ceil(np.sqrt(n))) + max(5, int(np.log10(n))))
    autocov = np.array([float(centred[: n - k] @ centred[k:]) / n for k in range(2 * most + 1) if k < n])
    rho = autocov / variance
    # The smallest lag after which a run of correlations is insignificant.
    run = max(5, int(np.sqrt(np.log10(n))))
    limit = 2 * np.sqrt(np.log10(n) / n)
    small = np.abs(rho[1:]) < limit
    last = next((k for k in range(len(small) - run + 1) if small[k : k + run].all()), len(small) // 2)
    reach = min(2 * max(last, 1), len(autocov) - 1)
    lag = np.arange(-reach, reach + 1)
    taper = np.clip(2 * (1 - np.abs(lag) / reach), 0, 1)
    cov = autocov[np.abs(lag)]
    g = float((taper * np.abs(lag) * cov).sum())
    spectrum = float((taper * cov).sum())
    if spectrum <= 0:
        return float(min(n / 3, 3 * np.sqrt(n)))
    length = (2 * g**2 / (2 * spectrum**2)) ** (1 / 3) * n ** (1 / 3)
    return float(np.clip(length, 1.0, min(n / 3, 3 * np.sqrt(n))))


def counts(n: int, mean_block: float, resamples: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """How often each of `n` samples is drawn in each stationary bootstrap resample, (resamples, n).

    Politis and Romano, "The stationary bootstrap" (JASA 1994): blocks of geometric length from uniform
    starts on the circle of samples.
    """
    drawn = np.empty((resamples, n), np.int64)
    drawn[:, 0] = rng.integers(0, n, resamples)
    fresh = rng.random((resamples, n)) < 1 / max(mean_block, 1.0)
    starts = rng.integers(0, n, (resamples, n))
    for k in range(1, n):
        drawn[:, k] = np.where(fresh[:, k], starts[:, k], (drawn[:, k - 1] + 1) % n)
    flat = (drawn + n * np.arange(resamples)[:, None]).ravel()
    return np.bincount(flat, minlength=resamples * n).reshape(resamples, n).astype(np.float64)


def agreement(sensor: Curve, predicted: Curve, rng: np.random.Generator) -> dict[str, Interval]:
    """Intervals of mae_mn, rmse_mn, bias_mn, r, ccc and r2, samples being resampled in blocks.

    The block is the longest that the sensor, the prediction or their difference ask for.

    Args:
        sensor: (T,) mN.
        predicted: (T,) mN; samples where either is NaN are left out.
        rng: source of the resamples.
    """
    good = np.isfinite(sensor) & np.isfinite(predicted)
    x, y = sensor[good], predicted[good]
    if len(x) < 8:
        return {}
    block = max(block_length(x), block_length(y), block_length(y - x))
    values = _scores(counts(len(x), block, RESAMPLES, rng), x, y)
    return {name: _interval(value) for name, value in values.items()}


def difference(sensor: Curve, first: Curve, second: Curve, rng: np.random.Generator) -> Interval:
    """Interval of MAE(first) − MAE(second), paired: both are resampled alike."""
    good = np.isfinite(sensor) & np.isfinite(first) & np.isfinite(second)
    gap = np.abs(first - sensor)[good] - np.abs(second - sensor)[good]
    if len(gap) < 8:
        return (float("nan"), float("nan"))
    weights = counts(len(gap), block_length(gap), RESAMPLES, rng)
    return _interval(weights @ gap / len(gap))


def over_groups(values: Sequence[float], groups: Sequence[str], rng: np.random.Generator) -> Interval:
    """Interval of the mean over recordings, whole groups (specimens) being resampled.

    Args:
        values: one a recording; NaN are left out.
        groups: the specimen of each.
        rng: source of the resamples.

    Returns:
        The interval; NaN of fewer than `LEAST_GROUPS`.
    """
    by: dict[str, list[float]] = {}
    for value, group in zip(values, groups, strict=True):
        if np.isfinite(value):
            by.setdefault(group, []).append(value)
    if len(by) < LEAST_GROUPS:
        return (float("nan"), float("nan"))
    sums = np.array([float(np.sum(v)) for v in by.values()])
    sizes = np.array([float(len(v)) for v in by.values()])
    picks = rng.integers(0, len(sums), (RESAMPLES, len(sums)))
    return _interval(sums[picks].sum(axis=1) / sizes[picks].sum(axis=1))


def _scores(weights: NDArray[np.float64], x: Curve, y: Curve) -> dict[str, Curve]:
    n = weights.sum(axis=1)
    mean_x, mean_y = weights @ x / n, weights @ y / n
    var_x = np.maximum(weights @ x**2 / n - mean_x**2, 0)
    var_y = np.maximum(weights @ y**2 / n - mean_y**2, 0)
    cov = weights @ (x * y) / n - mean_x * mean_y
    mse = weights @ (y - x) ** 2 / n
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            "mae_mn": weights @ np.abs(y - x) / n,
            "rmse_mn": np.sqrt(mse),
            "bias_mn": mean_y - mean_x,
            "r": cov / np.sqrt(var_x * var_y),
            "ccc": 2 * cov / (var_x + var_y + (mean_x - mean_y) ** 2),
            "r2": 1 - mse / var_x,
        }


def _interval(values: Curve) -> Interval:
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return (float("nan"), float("nan"))
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(values, [tail, 1 - tail])
    return (float(low), float(high))
