"""Figures of skill of a force curve: how fast, evenly, much and often tissue is loaded.

As those by which neurosurgical performance is described from measured forces (the recordings of
AnalyzeForceData). They describe a curve, not its agreement with another one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.scoring.force_metrics import contact_threshold
from learn.evaluation.metrics import Metric
from synth.arrays import Floats, Mask

if TYPE_CHECKING:
    from bench.scoring.result import Result

FIGURES = {
    "change_mn_per_s": Metric(
        "mean |dF/dt|", "mN/s", "Mean size of the change.", column="mean |dF/dt| [mN/s]"
    ),
    "variation": Metric(
        "coefficient of variation", "", "Standard deviation over mean.", column="coeff. of variation"
    ),
    "impulse_mns": Metric("impulse", "mN s", "Integral over time.", column="impulse [mN s]"),
    "idle_share": Metric("idle share", "%", "Share of time below the contact threshold.", 3, True, "idle"),
}
"""Definitions of the figures by their key in `score.json`."""


def skill(time_s: Floats, size_mn: Floats, used: Mask, threshold_mn: float) -> dict[str, float]:
    """The figures of a curve (T,) mN at rising times (T,) s over the samples `used` (T,); NaN if undefined.

    Time is that between neighbouring samples which are both used: nothing is bridged.
    """
    is_valid = used & np.isfinite(size_mn) & np.isfinite(time_s)
    is_pair = is_valid[1:] & is_valid[:-1]
    step_s, change = np.diff(time_s)[is_pair], np.diff(size_mn)[is_pair]
    middle = 0.5 * (size_mn[1:] + size_mn[:-1])[is_pair]
    total_s = float(step_s.sum())
    if not total_s > 0:
        return dict.fromkeys(FIGURES, float("nan"))
    mean = float(step_s @ middle) / total_s
    spread = float(np.sqrt(step_s @ (middle - mean) ** 2 / total_s))
    return {
        "change_mn_per_s": float(np.abs(change).sum()) / total_s,
        "variation": spread / mean if mean > 0 else float("nan"),
        "impulse_mns": float(step_s @ middle),
        "idle_share": float(step_s[middle < threshold_mn].sum()) / total_s,
    }


def skill_of(result: Result) -> dict[str, dict[str, float]]:
    """The figures of the sensor, if there is one, and of the main method, over the frames that both have."""
    predicted, sensor = result.methods[result.main].size_mn, result.sensor_mn
    used = ~result.lost & np.isfinite(predicted)
    if sensor is not None:
        used = used & result.scored & np.isfinite(sensor)
    curves = {result.main: predicted} if sensor is None else {"sensor": sensor, result.main: predicted}
    first = next(iter(curves.values()))
    threshold = contact_threshold(np.where(used, first, np.nan), result.noise_floor_mn)
    return {name: skill(result.time_s, curve, used, threshold) for name, curve in curves.items()}
