"""Numbers that say how right a force is: pure functions on arrays, in the arrays' own unit."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Moments:
    """Sums over pairs of (true, said), from which every agreement metric follows; moments of parts add up."""

    n: float = 0.0
    t: float = 0.0
    p: float = 0.0
    tt: float = 0.0
    pp: float = 0.0
    tp: float = 0.0
    absolute: float = 0.0

    @staticmethod
    def of(true: Floats, said: Floats) -> Moments:
        t, p = np.asarray(true, np.float64).ravel(), np.asarray(said, np.float64).ravel()
        return Moments(
            float(t.size),
            float(t.sum()),
            float(p.sum()),
            float(t @ t),
            float(p @ p),
            float(t @ p),
            float(np.abs(p - t).sum()),
        )

    def __add__(self, other: Moments) -> Moments:
        return Moments(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def over(self, unit: float) -> Moments:
        """Of the same pairs, both divided by `unit`."""
        u, u2 = 1 / unit, 1 / unit**2
        return Moments(
            self.n, self.t * u, self.p * u, self.tt * u2, self.pp * u2, self.tp * u2, self.absolute * u
        )


@dataclass(frozen=True)
class Agreement:
    """R² = 1 − SSE/SST; errors in the unit of the data; r (Pearson); CCC (Lin 1989)."""

    r2: float
    mae: float
    rmse: float
    bias: float
    r: float
    ccc: float


def agreement(m: Moments) -> Agreement:
    """Agreement from moments. R², r and CCC are NaN where the truth (or the answer, for r) is constant."""
    if m.n == 0:
        return Agreement(*[float("nan")] * 6)
    mean_t, mean_p = m.t / m.n, m.p / m.n
    var_t = max(m.tt / m.n - mean_t**2, 0.0)
    var_p = max(m.pp / m.n - mean_p**2, 0.0)
    cov = m.tp / m.n - mean_t * mean_p
    mse = max((m.pp - 2 * m.tp + m.tt) / m.n, 0.0)
    tiny = 1e-12 * max(m.tt / m.n, 1e-300)
    nan = float("nan")
    return Agreement(
        r2=1 - mse / var_t if var_t > tiny else nan,
        mae=m.absolute / m.n,
        rmse=mse**0.5,
        bias=mean_p - mean_t,
        r=cov / (var_t * var_p) ** 0.5 if var_t > tiny and var_p > 0 else nan,
        ccc=2 * cov / (var_t + var_p + (mean_t - mean_p) ** 2) if var_t > tiny else nan,
    )


def ghost_share(said: Floats, free: NDArray[np.bool_], threshold: float) -> float:
    """Share of the contact-free cells in which the answer is above `threshold`; NaN if none is free.

    `said`, `free`: (T, N, N); `threshold` in the unit of `said`.
    """
    return float((said[free] > threshold).mean()) if free.any() else float("nan")


def contact_mm(map_: Floats, pitch_mm: float) -> NDArray[np.float64]:
    """Centre (x, y) of what is above half the peak, weighted by force; mm on the grid. NaN for no force.

    `map_`: (N, N) ≥ 0.
    """
    peak = float(map_.max(initial=0.0))
    if peak <= 0:
        return np.full(2, np.nan)
    weight = np.where(map_ >= 0.5 * peak, map_, 0.0).astype(np.float64)
    rows, cols = np.indices(map_.shape)
    centre: NDArray[np.float64] = np.array([(weight * cols).sum(), (weight * rows).sum()]) / weight.sum()
    return centre * pitch_mm


def line(said: Floats, true: Floats) -> tuple[float, float]:
    """Calibration: slope and intercept of truth on answer by least squares; (1, 0) is calibrated."""
    x, y = np.asarray(said, np.float64), np.asarray(true, np.float64)
    spread = float(np.var(x))
    if spread == 0:
        return float("nan"), float("nan")
    slope = float(np.mean((x - x.mean()) * (y - y.mean())) / spread)
    return slope, float(y.mean() - slope * x.mean())
