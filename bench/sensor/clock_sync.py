"""Synchronisation of the sensor's clock with the video's: tissue moves when force changes.

The change of force in each frame interval of the calibration span is correlated with the tissue's motion in
it, for every candidate offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench import bootstrap
from bench.recording.meta import LEAST_INTERVALS
from synth.arrays import Floats

_STEPS_PER_FRAME = 8
_LEAST_R = 0.4
_RESAMPLES = 300
_SAME_PEAK = 0.95


@dataclass(frozen=True)
class Offset:
    """The offset between two clocks."""

    offset_s: float = 0.0  # to be added to the sensor's times [s]
    r: float = np.nan  # correlation at that offset
    r_at_zero: float = np.nan  # correlation without an offset
    deviation_s: float = np.nan  # standard deviation over all bootstrap resamples, including other peaks [s]
    refused: str = ""  # why the offset must not be used; empty if it may be


def find_offset(
    frame_s: Floats, speed: Floats, sensor_s: Floats, force_mn: Floats, search_s: float
) -> Offset:
    """The offset with the highest correlation between changes of force and motion.

    `frame_s`: (T,) times of the frames in the calibration span [s]; `speed`: (T,) mean speed of the tissue
    over the interval that ends at each frame [mm/s]; `sensor_s`: (N,) the sensor's own times [s]; `force_mn`:
    (N, 3) [mN]; NaN are left out; `search_s`: largest offset that is tried, in both directions [s].

    It is refused if there are too few intervals, the correlation is weak, its peak is at the end of the
    search, or fewer than 95% of block-bootstrap resamples have their peak within a frame of it.
    """
    is_valid = np.isfinite(force_mn).all(axis=1)
    t, force = sensor_s[is_valid], force_mn[is_valid]
    widths = np.diff(frame_s)
    shortage = f"frame intervals in the calibration span, {LEAST_INTERVALS} needed"
    if len(widths) < LEAST_INTERVALS:
        return Offset(refused=f"only {len(widths)} {shortage}")
    frame = float(np.median(widths))
    step = frame / _STEPS_PER_FRAME
    offsets = np.arange(-round(search_s / step), round(search_s / step) + 1) * step
    change = np.stack([_change(frame_s - offset, t, force) / widths for offset in offsets])
    motion = speed[1:]
    usable = np.isfinite(change).all(axis=0) & np.isfinite(motion)
    if (tracked_count := int(np.isfinite(motion).sum())) < LEAST_INTERVALS:
        return Offset(refused=f"only {tracked_count} tracked of {len(widths)} {shortage}")
    if usable.sum() < LEAST_INTERVALS:
        gap = "doesn't cover the calibration span with the search's margin on both sides"
        return Offset(refused=f"the sensor {gap}")
    change, motion = change[:, usable], motion[usable]
    r = _correlations(np.ones((1, len(motion))), change, motion)[0]
    if not np.isfinite(r).any():
        return Offset(refused="no motion or no change of force in the calibration span")
    best = int(np.nanargmax(r))
    rng = np.random.default_rng(0)  # reproducible
    weights = bootstrap.counts(len(motion), bootstrap.block_length(motion), _RESAMPLES, rng)
    peaks_s = offsets[np.nanargmax(np.nan_to_num(_correlations(weights, change, motion), nan=-1.0), axis=1)]
    is_same_peak = np.abs(peaks_s - offsets[best]) <= frame
    refused = ""
    if best in (0, len(offsets) - 1):
        refused = f"the correlation still rises at the end of the search, {search_s:g} s"
    elif r[best] < _LEAST_R:
        refused = f"the correlation of force and motion is only {r[best]:.2f}"
    elif is_same_peak.mean() < _SAME_PEAK:
        refused = f"ambiguous: the peak is elsewhere in {100 * (1 - is_same_peak.mean()):.0f}% of resamples"
    at_zero, deviation_s = float(r[len(offsets) // 2]), float(peaks_s.std())
    return Offset(_refine_peak(offsets, r, best), float(r[best]), at_zero, deviation_s, refused)


def _change(frame_s: Floats, sensor_s: Floats, force_mn: Floats) -> Floats:
    """Magnitude of the change of force over each frame interval [mN]; NaN outside the sensor's record."""
    sampled = np.stack(
        [np.interp(frame_s, sensor_s, f, left=np.nan, right=np.nan) for f in force_mn.T], axis=1
    )
    return np.asarray(np.linalg.norm(np.diff(sampled, axis=0), axis=1), np.float64)


def _correlations(weights: Floats, change: Floats, motion: Floats) -> Floats:
    """Weighted correlations, (B, L), for weights (B, K) and changes (L, K)."""
    n = weights.sum(axis=1, keepdims=True)
    mean_y = weights @ motion[:, None] / n
    mean_x = weights @ change.T / n
    cov = weights @ (change * motion).T / n - mean_x * mean_y
    var_x = weights @ (change**2).T / n - mean_x**2
    var_y = weights @ (motion**2)[:, None] / n - mean_y**2
    with np.errstate(divide="ignore", invalid="ignore"):
        r = cov / np.sqrt(var_x * var_y)
    return np.where((var_x > 1e-12) & (var_y > 1e-18), r, np.nan)


def _refine_peak(offsets: NDArray[np.floating], r: Floats, best: int) -> float:
    """Maximum of the parabola through the best offset and its neighbours."""
    if best in (0, len(r) - 1):
        return float(offsets[best])
    left, middle, right = r[best - 1 : best + 2]
    bend = left - 2 * middle + right
    shift = 0.5 * (left - right) / bend if np.isfinite(bend) and bend < 0 else 0.0
    return float(offsets[best] + shift * (offsets[1] - offsets[0]))
