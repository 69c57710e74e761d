"""Whether a model's intervals hold on sequences of known truth, and how wide they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Whether intervals of one level hold: shares of frames, means over sequences with 95% BCa."""

    level: float
    size: Interval
    axes: tuple[Interval, Interval, Interval]
    width_mn: float
    """Mean width of the interval of the force's size [mN]."""
    width_of_peak: float
    """The same as a share of the sequence's largest force."""
    axes_width_mn: tuple[float, float, float]
    unseen: float
    """Share of moving frames that are further from what was fitted than 99% of held-out frames."""
    distance: float
    """Median distance of moving frames, as a multiple of that."""

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready; NaN as null."""
        shares = {"size": self.size, **dict(zip("xyz", self.axes, strict=True))}
        widths = {"width_mn": self.width_mn, "width_of_peak": self.width_of_peak}
        widths |= {f"width_{axis}_mn": w for axis, w in zip("xyz", self.axes_width_mn, strict=True)}
        rest = widths | {"unseen": self.unseen, "distance": self.distance}
        told: dict[str, Any] = {"level": self.level}
        for name, share in shares.items():
            told[name] = {"mean": _known(share.mean), "low": _known(share.low), "high": _known(share.high)}
        return told | {name: _known(value) for name, value in rest.items()}


def cover(predictor: Predictor, clips: Sequence[Clip], source: str) -> list[Coverage]:
    """Holds a model's intervals, at every level, against sequences of known truth.

    Raises UserError if it has none.
    """
    found = predictor.card.intervals
    if found is None:
        raise UserError("the model has no intervals; `learn calibrate` fits them")
    rows: dict[float, list[list[float]]] = {level: [] for level in LEVELS}
    far = [np.zeros(0)]
    for clip in clips:
        said = predict_clip(predictor, clip, source)
        for level, held in rows.items():
            held.append(_held(found, said, clip, level))
        far.append(found.world.relative_distance(said.motion)[is_moving(said.motion)])
    moved = np.concatenate(far)
    return [_summed(level, np.array(held), moved) for level, held in rows.items()]


def _summed(level: float, values: NDArray[np.float64], moved: NDArray[np.float64]) -> Coverage:
    """`values`: (n, 9) of `_held`; `moved`: distances of the moving frames, as multiples of the usual."""
    rng, nan = np.random.default_rng(0), float("nan")
    shares = [interval(values[:, k], rng) for k in range(4)]
    means = [float(np.nanmean(v)) if np.isfinite(v).any() else nan for v in values[:, 4:].T]
    return Coverage(
        level=level,
        size=shares[0],
        axes=(shares[1], shares[2], shares[3]),
        width_mn=means[0],
        width_of_peak=means[1],
        axes_width_mn=(means[2], means[3], means[4]),
        unseen=float((moved > 1).mean()) if len(moved) else nan,
        distance=float(np.median(moved)) if len(moved) else nan,
    )


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _held(found: Intervals, said: Prediction, clip: Clip, level: float) -> list[float]:
    """Shares held of size, x, y and z, then widths [mN] and the first over the peak."""
    band, young = found.bound(said, level), clip.young_kpa
    force = clip.force / young
    size = np.linalg.norm(force, axis=1)
    axes = _within(force, band.axes_low, band.axes_high).mean(0)
    width, peak = float((band.high - band.low).mean()), float(size.max())
    return [
        float(_within(size, band.low, band.high).mean()),
        *axes.tolist(),
        young * width,
        width / peak if peak > 0 else float("nan"),
        *(young * (band.axes_high - band.axes_low).mean(0)).tolist(),
    ]


def _within(
    true: NDArray[np.floating], low: NDArray[np.floating], high: NDArray[np.floating]
) -> NDArray[np.bool_]:
    return np.asarray((true >= low) & (true <= high))
