"""Whether a model's intervals hold on sequences of known truth, and how wide they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learn.checkpoint import Card
from learn.data.clips import Clip
from learn.evaluation.evaluate import FREE
from learn.evaluation.fit_intervals import read_said, read_truth
from learn.evaluation.statistics import Interval, interval
from learn.inference.predict import Predictor
from learn.uncertainty.features import is_moving
from learn.uncertainty.intervals import Intervals, Said, Truth
from synth.errors import UserError


@dataclass(frozen=True)
class Coverage:
    """Whether intervals of one level hold: shares of frames (or cells), means over sequences."""

    level: float
    size: Interval
    axes: tuple[Interval, Interval, Interval]
    map: Interval
    contact: Interval
    """Of cells of the map that carry force."""
    width_mn: float
    """Mean width of the interval of the force's size [mN]."""
    width_of_peak: float
    """The same as a share of the sequence's largest force."""
    axes_width_mn: tuple[float, float, float]
    unseen: float
    """Share of moving frames that are further from what was fitted than 99% of held-out frames."""
    distance: float
    """Median distance of moving frames, as a multiple of that."""


def coverage(predictor: Predictor, clips: Sequence[Clip], source: str, level: float) -> Coverage:
    """Holds a model's intervals against sequences of known truth. Raises UserError if it has none."""
    found = predictor.card.intervals
    if found is None:
        raise UserError("the model has no intervals; `learn intervals` fits them")
    rows, far = [], []
    for clip in clips:
        said, truth = read_said(predictor, clip, source), read_truth(clip, predictor.card)
        rows.append(_held(found, said, truth, clip, predictor.card, level))
        far.append((found.world.distance(said.motion) / found.world.usual)[is_moving(said.motion)])
    values, moved = np.array(rows), np.concatenate([np.zeros(0), *far])
    rng = np.random.default_rng(0)
    shares = [interval(values[:, k], rng) for k in range(6)]
    means = [float(np.nanmean(v)) if np.isfinite(v).any() else float("nan") for v in values[:, 6:].T]
    return Coverage(
        level=level,
        size=shares[0],
        axes=(shares[1], shares[2], shares[3]),
        map=shares[4],
        contact=shares[5],
        width_mn=means[0],
        width_of_peak=means[1],
        axes_width_mn=(means[2], means[3], means[4]),
        unseen=float((moved > 1).mean()) if len(moved) else float("nan"),
        distance=float(np.median(moved)) if len(moved) else float("nan"),
    )


def _held(found: Intervals, said: Said, truth: Truth, clip: Clip, card: Card, level: float) -> list[float]:
    """Shares held of size, x, y, z, map and contact, then widths [mN] and the first over the peak."""
    band, young = found.bound(said, level), clip.young_kpa
    size = np.linalg.norm(truth.force, axis=1)
    axes = _within(truth.force, band.axes_low, band.axes_high).mean(0)
    low, high = found.bound_map(said, level)
    inside = np.broadcast_to(clip.mask > 0, low.shape)
    kept = _within(truth.magnitude, low, high)
    touched = inside & (truth.magnitude >= FREE * card.scales.target)
    width, peak = float((band.high - band.low).mean()), float(size.max())
    return [
        float(_within(size, band.low, band.high).mean()),
        *axes.tolist(),
        float(kept[inside].mean()),
        float(kept[touched].mean()) if touched.any() else float("nan"),
        young * width,
        width / peak if peak > 0 else float("nan"),
        *(young * (band.axes_high - band.axes_low).mean(0)).tolist(),
    ]


def _within(
    true: NDArray[np.floating], low: NDArray[np.floating], high: NDArray[np.floating]
) -> NDArray[np.bool_]:
    return np.asarray((true >= low) & (true <= high))
