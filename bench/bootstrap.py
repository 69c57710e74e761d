"""The stationary bootstrap: intervals for curves with correlated samples. SciPy has none."""

from __future__ import annotations

import numpy as np

from synth.arrays import Floats

Interval = tuple[float, float]

RESAMPLES = 1000
LEAST_SAMPLES = 8
LEVEL = 0.95


def block_length(x: Floats) -> float:
    """Mean block length, in samples, for the stationary bootstrap of the mean of `x` (T,).

    Politis and White, "Automatic block-length selection for the dependent bootstrap" (Econometric Reviews
    2004), with the correction of Patton, Politis and White (2009).
    """
    n = len(x)
    centred = x - x.mean()
    variance = float(centred @ centred) / n
    if n < LEAST_SAMPLES or variance == 0:
        return 1.0
    max_lag = min(n - 1, int(np.ceil(np.sqrt(n))) + max(5, int(np.log10(n))))
    autocov = np.array([float(centred[: n - k] @ centred[k:]) / n for k in range(2 * max_lag + 1) if k < n])
    rho = autocov / variance
    # The smallest lag after which a run of correlations is insignificant.
    run = max(5, int(np.sqrt(np.log10(n))))
    limit = 2 * np.sqrt(np.log10(n) / n)
    small = np.abs(rho[1:]) < limit
    cutoff = next((k for k in range(len(small) - run + 1) if small[k : k + run].all()), len(small) // 2)
    reach = min(2 * max(cutoff, 1), len(autocov) - 1)
    lag = np.arange(-reach, reach + 1)
    taper = np.clip(2 * (1 - np.abs(lag) / reach), 0, 1)
    cov = autocov[np.abs(lag)]
    g = float((taper * np.abs(lag) * cov).sum())
    spectrum, longest = float((taper * cov).sum()), float(min(n / 3, 3 * np.sqrt(n)))
    if spectrum <= 0:
        return longest
    length = (2 * g**2 / (2 * spectrum**2)) ** (1 / 3) * n ** (1 / 3)
    return float(np.clip(length, 1.0, longest))


def counts(n: int, mean_block: float, resamples: int, rng: np.random.Generator) -> Floats:
    """Counts of each of `n` samples in each resample, (resamples, n), of blocks of geometric length.

    Politis and Romano, "The stationary bootstrap" (JASA 1994).
    """
    indices = np.empty((resamples, n), np.int64)
    indices[:, 0] = rng.integers(0, n, resamples)
    fresh = rng.random((resamples, n)) < 1 / max(mean_block, 1.0)
    starts = rng.integers(0, n, (resamples, n))
    for k in range(1, n):
        indices[:, k] = np.where(fresh[:, k], starts[:, k], (indices[:, k - 1] + 1) % n)
    flat = (indices + n * np.arange(resamples)[:, None]).ravel()
    return np.bincount(flat, minlength=resamples * n).reshape(resamples, n).astype(np.float64)


def interval(values: Floats) -> Interval:
    """The middle 95% of resampled values (R,); those that are not finite are left out."""
    values = values[np.isfinite(values)]
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]) if len(values) else (np.nan, np.nan)
    return float(low), float(high)
