"""How sure a mean over sequences is, and whether two models differ. The sequence is the unit, not the frame.

Frames of one sequence show one contact on one tissue; counting them as independent would make any interval
ten times too narrow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from learn.evaluation.metrics import agreement, agreements
from synth.errors import UserError

Floats = NDArray[np.float64]

_LEVEL = 0.95
_DRAWS = 4000
_SIGNS = 10_000


@dataclass(frozen=True)
class Interval:
    """A mean over sequences with its interval."""

    mean: float
    low: float
    high: float
    n: int


def interval(values: Floats, rng: np.random.Generator, draws: int = _DRAWS) -> Interval:
    """Mean and BCa bootstrap interval over sequences (Efron 1987). NaNs are sequences without a value.

    `values`: (n,), any unit. With fewer than three values, or none that differ, there is no interval (NaN).
    """
    v = np.asarray(values, np.float64)
    v = v[np.isfinite(v)]
    nan = float("nan")
    if v.size == 0:
        return Interval(nan, nan, nan, 0)
    if v.size < 3 or np.ptp(v) == 0:
        return Interval(float(v.mean()), nan, nan, int(v.size))
    boot = v[rng.integers(0, v.size, (draws, v.size))].mean(axis=1)
    return _bca(float(v.mean()), boot, (v.sum() - v) / (v.size - 1))


def pooled_r2(moments: Floats, rng: np.random.Generator, draws: int = _DRAWS) -> Interval:
    """R² over everything that the sequences hold together, and its BCa interval over sequences.

    `moments`: (n, 7), `learn.evaluation.metrics.moments` of each sequence. With fewer than three sequences
    there is no interval (NaN).
    """
    m = np.asarray(moments, np.float64)
    total, count = m.sum(axis=0), len(m)
    if count < 3:
        return Interval(agreement(total).r2, float("nan"), float("nan"), count)
    times = rng.multinomial(count, np.full(count, 1 / count), draws)
    return _bca(agreement(total).r2, agreements(times @ m)["r2"], agreements(total - m)["r2"])


def _bca(value: float, boot: Floats, left_out: Floats) -> Interval:
    """The interval of a statistic from its bootstrap draws and its leave-one-out values."""
    draws = len(boot)
    # Ties count half, else few sequences or a spike of equal values tilt the bias correction.
    below = (boot < value).mean() + 0.5 * (boot == value).mean()
    z0 = stats.norm.ppf(np.clip(below, 1 / draws, 1 - 1 / draws))
    d = left_out.mean() - left_out
    spread = float((d**2).sum())
    acceleration = float((d**3).sum() / (6 * spread**1.5)) if spread > 0 else 0.0
    z = z0 + stats.norm.ppf([(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    low, high = np.quantile(boot, stats.norm.cdf(z0 + z / (1 - acceleration * z)))
    return Interval(value, float(low), float(high), len(left_out))


@dataclass(frozen=True)
class Paired:
    """Model B against model A on the same sequences."""

    difference: Interval
    """B − A, mean over sequences."""
    p: float
    """Two-sided, sign-flip permutation test of the mean difference."""
    wins: float
    """Share of sequences on which B's value is the larger; ties count half."""


def paired(a: Floats, b: Floats, rng: np.random.Generator) -> Paired:
    """Compares two models, sequence by sequence. `a`, `b`: (n,) in the same order.

    Exact (all sign patterns) up to 13 sequences, by random patterns above. Raises UserError for lengths that
    differ or no common sequence.
    """
    if len(a) != len(b):
        raise UserError(f"paired test: {len(a)} against {len(b)} sequences")
    d = np.asarray(b, np.float64) - np.asarray(a, np.float64)
    d = d[np.isfinite(d)]
    if d.size == 0:
        raise UserError("paired test: no sequence has a value from both models")
    if d.size <= 13:
        signs = 1 - 2 * ((np.arange(2**d.size)[:, None] >> np.arange(d.size)) & 1)
        p = float((np.abs(signs @ d) >= abs(d.sum()) * (1 - 1e-12)).mean())
    else:
        signs = rng.choice([-1.0, 1.0], (_SIGNS, d.size))
        p = float((1 + (np.abs(signs @ d) >= abs(d.sum()) * (1 - 1e-12)).sum()) / (1 + _SIGNS))
    return Paired(interval(d, rng), p, float((d > 0).mean() + 0.5 * (d == 0).mean()))
