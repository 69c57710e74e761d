"""How right a force is: what each number is, and pure functions on arrays, in the arrays' own unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Metric:
    """One score: what it is called and how it is shown, wherever it is shown."""

    name: str
    unit: str = ""
    """As shown: ms and % are made of s and shares; empty for a number."""
    about: str = ""
    best: Literal["low", "high", "zero", "one", ""] = ""
    """Which value is the best; empty for what is no merit."""
    digits: int = 3
    """How many digits are shown."""
    relative: bool = False
    """Whether a constant factor on the prediction leaves it as it is, or it speaks of the truth alone."""
    column: str = ""
    """Heading in a narrow table; empty: not there."""
    listed: bool = True
    """Whether `learn eval` lists it; its JSON holds it in any case."""

    @property
    def cell_unit(self) -> str:
        """What is written behind each number under a heading."""
        return self.unit if self.unit in ("%", "ms") else ""

    @property
    def heading(self) -> str:
        """The name, with its unit if the numbers are shown without."""
        return f"{self.name} [{self.unit}]" if self.unit and not self.cell_unit else self.name


_DENSITY = "mN/mm²"
METRICS = {
    "force_r2_pooled": Metric("total force: R², all frames", column="force R²"),
    "force_r2": Metric("total force: R²", listed=False),
    "force_mae": Metric("total force: MAE", "mN", column="total force MAE [mN]"),
    "force_rmse": Metric("total force: RMSE", "mN"),
    "force_bias": Metric("total force: bias", "mN", "Mean of prediction minus truth."),
    "force_r": Metric("total force: correlation", about="Pearson's r over frames."),
    "force_ccc": Metric("total force: concordance", about="Lin's concordance over frames."),
    "vector_error_mn": Metric("total force: error of the vector", "mN", "Mean length of its error."),
    "peak_error_share": Metric("peak force: relative error", column="peak force error"),
    "map_r2_pooled": Metric("force map: R², all cells", column="map R²"),
    "map_r2": Metric("force map: R²", about="Over tissue cells.", column="map R²", listed=False),
    "map_mae": Metric("force map: MAE", _DENSITY),
    "map_rmse": Metric("force map: RMSE", _DENSITY, column="map RMSE [mN/mm²]"),
    "map_bias": Metric("force map: bias", _DENSITY, "Mean of prediction minus truth.", listed=False),
    "map_r": Metric("force map: correlation", about="Pearson's r over tissue cells."),
    "map_ccc": Metric("force map: concordance", about="Lin's concordance over cells.", listed=False),
    "vector_r2": Metric("force map: R² of components", about="1 − SSE/SST of x, y and z."),
    "ghost": Metric(
        "false positives: contact-free area above 5 mN",
        about="Share of it where a contact-sized patch would carry more.",
    ),
    "ghost_relative": Metric(
        "false positives: contact-free area above 5% of scale",
        about="Share of it; the scale is the training data's 99.9th percentile.",
        column="ghost area",
    ),
    "ghost_far": Metric(
        "false positives: the same beyond 2 mm of a contact",
        about="Without the rim, where a contact found a cell aside shows up too.",
        column="ghost area beyond 2 mm",
    ),
    "stray_mn": Metric(
        "background force: on contact-free area", "mN", "Mean over frames.", column="force off contact [mN]"
    ),
    "low_over_mn": Metric(
        "over-prediction in low-force frames", "mN", "Of the total force.", column="over in low frames [mN]"
    ),
    "localisation_mm": Metric(
        "contact centre: median error", "mm", "Over frames that aren't low.", column="contact centre [mm]"
    ),
    "calibration_slope": Metric("calibration: slope of truth on prediction", about="By least squares."),
    "calibration_offset_mn": Metric("calibration: offset of truth on prediction", "mN", listed=False),
}
"""By key of `learn eval --json`: the only place that says what a score is."""


def moments(true: Floats, predicted: Floats) -> Floats:
    """Sums over pairs (true, predicted), from which every agreement metric follows; those of parts add up.

    Returns: (7,) count and sums of t, p, t², p², tp and |p − t|.
    """
    t, p = (np.asarray(values, np.float64).ravel() for values in (true, predicted))
    return np.array([t.size, t.sum(), p.sum(), t @ t, p @ p, t @ p, np.abs(p - t).sum()])


@dataclass(frozen=True)
class Agreement:
    """R² = 1 − SSE/SST about the truth's mean, so bias and gain errors count; errors in the unit of the data;
    r (Pearson); CCC (Lin, "A concordance correlation coefficient to evaluate reproducibility", Biometrics
    1989)."""

    r2: float
    mae: float
    rmse: float
    bias: float
    r: float
    ccc: float


def agreement(moments: Floats) -> Agreement:
    """Agreement from moments (7,). R², r and CCC are NaN where the truth (for r the answer) is constant."""
    return Agreement(**{name: float(value) for name, value in agreements(moments).items()})


def agreements(moments: Floats) -> dict[str, NDArray[np.float64]]:
    """Fields of `Agreement`, each (...), from many moments (..., 7) at once."""
    n, t, p, tt, pp, tp, absolute = np.moveaxis(np.asarray(moments, np.float64), -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_t, mean_p = t / n, p / n
        var_t, var_p = np.maximum(tt / n - mean_t**2, 0), np.maximum(pp / n - mean_p**2, 0)
        cov = tp / n - mean_t * mean_p
        mse = np.maximum((pp - 2 * tp + tt) / n, 0)
        varies = var_t > 1e-12 * np.maximum(tt / n, 1e-300)
        return {
            "r2": np.where(varies, 1 - mse / var_t, np.nan),
            "mae": absolute / n,
            "rmse": np.sqrt(mse),
            "bias": mean_p - mean_t,
            "r": np.where(varies & (var_p > 0), cov / np.sqrt(var_t * var_p), np.nan),
            "ccc": np.where(varies, 2 * cov / (var_t + var_p + (mean_t - mean_p) ** 2), np.nan),
        }


def false_positive_share(predicted: Floats, free: NDArray[np.bool_], threshold: float) -> float:
    """Share of the contact-free cells in which the prediction is above `threshold`; NaN if none is free.

    `predicted`, `free`: (T, N, N); `threshold` in the unit of `predicted`.
    """
    return float((predicted[free] > threshold).mean()) if free.any() else float("nan")


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


def line(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope and intercept of `y` on `x` by least squares; of truth on prediction (1, 0) is calibrated."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if len(x) == 0 or np.ptp(x) == 0:
        return float("nan"), float("nan")
    slope = float(np.mean((x - x.mean()) * (y - y.mean())) / np.var(x))
    return slope, float(y.mean() - slope * x.mean())
