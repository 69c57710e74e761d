"""Whether a model's intervals hold on sequences of known truth, and how wide they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from learn.data.clips import Clip
from learn.evaluation.fit_intervals import predict_clip
from learn.evaluation.statistics import Interval, interval
from learn.inference.predict import Predictor
from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.features import is_moving
from learn.uncertainty.intervals import Intervals, Prediction
from synth.errors import UserError


@dataclass(frozen=True)
class Coverage:
    """Whether intervals of one level hold, on sequences that weigh alike."""

    level: float
    shares: dict[str, Interval]
    """Frames whose force's `size`, `x`, `y` and `z` lie within: means over sequences with 95% BCa."""
    values: dict[str, float]
    """`width_mn`: mean width of the interval of the force's size [mN]; `width_of_peak`: the same over the
    sequence's largest force; `width_x_mn` and its like. `unseen`: share of moving frames that are further
    from what was fitted than 99% of held-out frames; `distance`: median of theirs, as a multiple of that."""

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready; NaN as null."""
        ends = {name: {"mean": s.mean, "low": s.low, "high": s.high} for name, s in self.shares.items()}
        known = {name: _known(one) for name, one in ends.items()}
        return {"level": self.level, **known, **_known(self.values)}


def cover(predictor: Predictor, clips: Sequence[Clip], source: str) -> list[Coverage]:
    """Compares a model's intervals, at every level, with sequences of known truth.

    Raises UserError if it has none.
    """
    found = predictor.card.intervals
    if found is None:
        raise UserError("the model has no intervals; `learn calibrate` fits them")
    rows: dict[float, list[dict[str, float]]] = {level: [] for level in LEVELS}
    far = [np.zeros(0)]
    for clip in clips:
        predicted = predict_clip(predictor, clip, source)
        for level, held in rows.items():
            held.append(_held(found, predicted, clip, level))
        far.append(found.world.relative_distance(predicted.motion)[is_moving(predicted.motion)])
    moved = np.concatenate(far)
    nan, out = float("nan"), []
    for level, held in rows.items():
        rng = np.random.default_rng(0)
        columns = {name: np.array([row[name] for row in held]) for name in held[0]}
        shares = {name: interval(columns.pop(name), rng) for name in ("size", *"xyz")}
        values = {k: float(np.nanmean(v)) if np.isfinite(v).any() else nan for k, v in columns.items()}
        values["unseen"] = float((moved > 1).mean()) if len(moved) else nan
        values["distance"] = float(np.median(moved)) if len(moved) else nan
        out.append(Coverage(level, shares, values))
    return out


def _known(values: dict[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def _held(found: Intervals, predicted: Prediction, clip: Clip, level: float) -> dict[str, float]:
    """One sequence's shares of frames held, and widths, by the names of `Coverage`."""
    band, young = found.bound(predicted, level), clip.young_kpa
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
