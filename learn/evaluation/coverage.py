"""Coverage and width of a model's prediction intervals on sequences of known force."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from learn.data.clips import Clip
from learn.evaluation.fit_intervals import predict_clip
from learn.evaluation.statistics import Interval, as_plain, interval
from learn.inference.predict import Predictor
from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.features import is_moving
from learn.uncertainty.intervals import Intervals, Prediction


@dataclass(frozen=True)
class Coverage:
    """Coverage of one level's intervals, all sequences weighted equally."""

    level: float
    shares: dict[str, Interval]
    """Share of frames with `size`, `x`, `y` or `z` of the force within: means with 95% BCa intervals."""
    values: dict[str, float]
    """`width_mn`, `width_x_mn`, ...: mean widths [mN]; `width_of_peak`: of the size's, over the sequence's
    largest force. `out_of_distribution`: share of moving frames further from the training data than 99% of
    held-out frames; `distance`: median distance of moving frames, as a multiple of that."""

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready; NaN as null."""
        ends = {name: {"mean": s.mean, "low": s.low, "high": s.high} for name, s in self.shares.items()}
        return dict(as_plain({"level": self.level, **ends, **self.values}))


def cover(predictor: Predictor, clips: Sequence[Clip], source: str) -> list[Coverage]:
    """Coverage at every level, of a model with intervals."""
    intervals = predictor.card.intervals
    assert intervals is not None
    rows: dict[float, list[dict[str, float]]] = {level: [] for level in LEVELS}
    clip_distances = [np.zeros(0)]
    for clip in clips:
        predicted = predict_clip(predictor, clip, source)
        for level, clip_rows in rows.items():
            clip_rows.append(_cover_clip(intervals, predicted, clip, level))
        motion = predicted.motion
        clip_distances.append(intervals.distribution.relative_distance(motion)[is_moving(motion)])
    distances, coverages = np.concatenate(clip_distances), []
    for level, clip_rows in rows.items():
        rng = np.random.default_rng(0)
        columns = {name: np.array([row[name] for row in clip_rows]) for name in clip_rows[0]}
        shares = {name: interval(columns.pop(name), rng) for name in ("size", *"xyz")}
        values = {k: float(np.nanmean(v)) if np.isfinite(v).any() else math.nan for k, v in columns.items()}
        values["out_of_distribution"] = float((distances > 1).mean()) if len(distances) else math.nan
        values["distance"] = float(np.median(distances)) if len(distances) else math.nan
        coverages.append(Coverage(level, shares, values))
    return coverages


def _cover_clip(intervals: Intervals, predicted: Prediction, clip: Clip, level: float) -> dict[str, float]:
    """One sequence's coverages and widths, by the names of `Coverage`."""
    band, young = intervals.bound(predicted, level), clip.young_kpa
    force = clip.force / young
    size = np.linalg.norm(force, axis=1)
    axes = ((force >= band.axes_low) & (force <= band.axes_high)).mean(0)
    width, peak = float((band.high - band.low).mean()), float(size.max())
    widths = young * (band.axes_high - band.axes_low).mean(0)
    return {
        "size": float(((size >= band.low) & (size <= band.high)).mean()),
        **dict(zip("xyz", axes.tolist(), strict=True)),
        "width_mn": young * width,
        "width_of_peak": width / peak if peak > 0 else math.nan,
        **{f"width_{axis}_mn": value for axis, value in zip("xyz", widths.tolist(), strict=True)},
    }
