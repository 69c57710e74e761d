"""Definitions of the scores, and pure functions on arrays, in the arrays' own unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from synth.arrays import Array, Mask


@dataclass(frozen=True)
class Metric:
    """Name, unit and format of one score."""

    name: str
    unit: str = ""  # as displayed: ms and % are converted from s and shares; empty if dimensionless
    about: str = ""
    digits: int = 3  # significant digits displayed
    relative: bool = False  # whether a constant factor on the prediction doesn't change it
    column: str = ""  # heading in a narrow table; empty: not listed there
    listed: bool = True  # whether `learn eval --all` lists it

    @property
    def cell_unit(self) -> str:
        """The unit displayed after each number instead of in the heading."""
        return self.unit if self.unit in ("%", "ms") else ""

    @property
    def heading(self) -> str:
        """The name, with the unit unless that is displayed after each number."""
        return f"{self.name} [{self.unit}]" if self.unit and not self.cell_unit else self.name


METRICS = {
    "force_r2_pooled": Metric("total force: R², all frames", column="force R²"),
    "force_mae": Metric("total force: MAE", "mN", column="total force MAE [mN]"),
    "force_rmse": Metric("total force: RMSE", "mN"),
    "force_bias": Metric("total force: bias", "mN"),  # prediction minus truth
    "force_r": Metric("total force: correlation"),  # over frames, as the next
    "force_ccc": Metric("total force: concordance"),
    "vector_error_mn": Metric("total force: error of the vector", "mN"),
    "peak_error_share": Metric("peak force: relative error", column="peak force error"),
    "map_r2_pooled": Metric("force map: R², all cells", column="map R²"),
    "map_r2": Metric("force map: R²", column="map R²", listed=False),
    "map_mae": Metric("force map: MAE", "mN/mm²"),
    "map_rmse": Metric("force map: RMSE", "mN/mm²", column="map RMSE [mN/mm²]"),
    "map_r": Metric("force map: correlation"),  # over tissue cells
    "vector_r2": Metric("force map: R² of components"),  # x, y and z together
    # The scale is the training data's 99.9th percentile.
    "false_positive_relative": Metric(
        "false positives: contact-free area above 5% of scale", column="false-positive area"
    ),
    "off_target_mn": Metric("off-target force: on contact-free area", "mN", column="off-target force [mN]"),
    "low_over_mn": Metric(
        "over-prediction in low-force frames", "mN", column="over in low frames [mN]"
    ),  # of the total force
    # Over frames above low force.
    "localisation_mm": Metric("contact centre: median error", "mm", column="contact centre [mm]"),
    "calibration_slope": Metric("calibration: slope of truth on prediction"),  # least squares
}
"""Scores that `learn eval` lists, by their key in its JSON, which has some more."""


def moments(true: Array, predicted: Array) -> Array:
    """Count and sums of t, p, t², p², tp and |p − t| over pairs (true, predicted), (7,), which add up."""
    t, p = (np.asarray(values, np.float64).ravel() for values in (true, predicted))
    return np.array([t.size, t.sum(), p.sum(), t @ t, p @ p, t @ p, np.abs(p - t).sum()])


def agreement(moments: Array) -> dict[str, float]:
    """`agreements` of moments (7,)."""
    return {name: float(value) for name, value in agreements(moments).items()}


def agreements(moments: Array) -> dict[str, Array]:
    """Scores by name, each (...), from moments (..., 7): r2 = 1 − SSE/SST about the truth's mean; mae, rmse
    and bias in the unit of the data; Pearson's r; ccc of Lin, "A concordance correlation coefficient to
    evaluate reproducibility", Biometrics 1989. r2, r and ccc are NaN for constant truth, r for a constant
    prediction."""
    n, t, p, tt, pp, tp, absolute = np.moveaxis(np.asarray(moments, np.float64), -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_t, mean_p = t / n, p / n
        var_t, var_p = np.maximum(tt / n - mean_t**2, 0), np.maximum(pp / n - mean_p**2, 0)
        cov = tp / n - mean_t * mean_p
        mse = np.maximum((pp - 2 * tp + tt) / n, 0)
        varies, moves = (v > 1e-12 * np.maximum(s / n, 1e-300) for v, s in ((var_t, tt), (var_p, pp)))
        return {
            "r2": np.where(varies, 1 - mse / var_t, np.nan),
            "mae": absolute / n,
            "rmse": np.sqrt(mse),
            "bias": mean_p - mean_t,
            "r": np.where(varies & moves, cov / np.sqrt(var_t * var_p), np.nan),
            "ccc": np.where(varies, 2 * cov / (var_t + var_p + (mean_t - mean_p) ** 2), np.nan),
        }


def false_positive_share(predicted: Array, free: Mask, threshold: float) -> float:
    """Share of the cells `free` with a prediction above `threshold`, in its unit; NaN if there are none."""
    return float((predicted[free] > threshold).mean()) if free.any() else float("nan")


def contact_mm(map_: Array, pitch_mm: float) -> Array:
    """Centroid (x, y) [mm on the grid] of a map (N, N) ≥ 0 above half its peak; NaN without force."""
    peak = float(map_.max(initial=0.0))
    if peak <= 0:
        return np.full(2, np.nan)
    weight = np.where(map_ >= 0.5 * peak, map_, 0.0).astype(np.float64)
    return pitch_mm * np.array(ndimage.center_of_mass(weight)[::-1])


def line(x: Array, y: Array) -> tuple[float, float]:
    """Slope and intercept of `y` on `x` by least squares; NaN for constant `x`."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if len(x) == 0 or np.ptp(x) == 0:
        return float("nan"), float("nan")
    slope = float(np.mean((x - x.mean()) * (y - y.mean())) / np.var(x))
    return slope, float(y.mean() - slope * x.mean())
