"""Scores of a model by sequence, in mN, for tissue of known E, to which forces are proportional."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learn.checkpoint import ModelCard
from learn.data.clips import Clip, amount, target
from learn.evaluation.metrics import agreement, contact_mm, false_positive_share, line, moments
from learn.evaluation.statistics import Interval, as_plain, interval, pooled_r2
from learn.inference.predict import Predictor, force_size, length, total_force
from synth.arrays import Floats, Map
from synth.system.terminal import ProgressCallback

# Shares of the training data's 99.9th percentile: cells are contact-free under the first, frames of low force
# under the second, and relative false positives above it.
FREE, LOW = 0.01, 0.05


@dataclass(frozen=True)
class ClipScore:
    """Scores of one sequence. Forces in mN, densities in mN/mm²."""

    name: str
    young_kpa: float
    map: NDArray[np.floating]  # (7,) `moments` of the density's length, over tissue cells of all frames
    true_mn: Floats  # (T,) size of the total force; of a map of lengths see `amount`
    predicted_mn: Floats
    others: dict[str, float]  # further scores by key of `METRICS`

    def as_row(self) -> dict[str, float]:
        """All scores by key of `METRICS`."""
        force = moments(self.true_mn, self.predicted_mn)
        row = {f"map_{name}": value for name, value in agreement(self.map).items()}
        return row | {f"force_{name}": value for name, value in agreement(force).items()} | self.others


def score(clip: Clip, predicted: Map, card: ModelCard) -> ClipScore:
    """Scores the prediction of one sequence. `predicted`: (T, C, N, N), physical."""
    grid, parts, young = card.settings.grid, predicted.shape[1], clip.young_kpa
    pitch = grid.pitch_mm
    true = np.stack([target(clip, t, parts) for t in range(clip.frames)]) * np.float32(young)
    inside = np.broadcast_to(np.asarray(clip.mask) > 0, (clip.frames, *clip.mask.shape))
    size, true_size = length(predicted), length(true)
    unit = card.scales.target * young
    contact = true_size >= FREE * unit
    free, total = inside & ~contact, total_force(predicted, grid)
    predicted_mn = force_size(total)
    true_mn: Floats = np.linalg.norm(amount(clip, parts, pitch) * young, axis=1)
    low = true_mn < LOW * card.scales.force * young
    centres = [contact_mm(size[t], pitch) - contact_mm(true_size[t], pitch) for t in np.flatnonzero(~low)]
    distances = [d for d in (float(np.linalg.norm(centre)) for centre in centres) if math.isfinite(d)]
    peak = float(true_mn.max())
    others = {}
    if parts == 3:
        components = np.broadcast_to(inside[:, None], predicted.shape)
        others["vector_r2"] = agreement(moments(true[components], predicted[components]))["r2"]
        others["vector_error_mn"] = float(np.linalg.norm(total - clip.force, axis=1).mean())
    others |= {
        "peak_error_share": abs(float(predicted_mn.max()) - peak) / peak if peak > 0 else math.nan,
        "false_positive_relative": false_positive_share(size, free, LOW * unit),
        "off_target_mn": float((size * free).sum((1, 2)).mean() * pitch**2),
        "localisation_mm": float(np.median(distances)) if distances else math.nan,
        "low_over_mn": float(np.maximum(predicted_mn - true_mn, 0)[low].mean()) if low.any() else math.nan,
    }
    agreed = moments(true_size[inside], size[inside])
    return ClipScore(clip.name, young, agreed, true_mn, predicted_mn, others)


@dataclass(frozen=True)
class EvaluationReport:
    """A model's scores by sequence."""

    clips: list[ClipScore]

    def per_clip(self) -> list[dict[str, float]]:
        """Scores of each sequence."""
        return [c.as_row() for c in self.clips]

    def summary(self) -> dict[str, float]:
        """Means over sequences of every score, and pooled R² (`*_pooled`)."""
        rows, clips = self.per_clip(), self.clips
        out = {k: _mean([r[k] for r in rows]) for k in rows[0]}
        out["map_r2_pooled"] = agreement(np.sum([c.map for c in clips], axis=0))["r2"]
        true = np.concatenate([c.true_mn for c in clips])
        predicted = np.concatenate([c.predicted_mn for c in clips])
        out["force_r2_pooled"] = agreement(moments(true, predicted))["r2"]
        out["calibration_slope"], out["calibration_offset_mn"] = line(predicted, true)
        return out

    def intervals(self) -> dict[str, Interval]:
        """Mean and BCa interval over sequences of every score, and of the pooled R²."""
        rows, rng = self.per_clip(), np.random.default_rng(0)
        out = {k: interval(np.array([r[k] for r in rows]), rng) for k in rows[0]}
        forces = [moments(c.true_mn, c.predicted_mn) for c in self.clips]
        for name, parts in (("map_r2_pooled", [c.map for c in self.clips]), ("force_r2_pooled", forces)):
            out[name] = pooled_r2(np.array(parts), rng)
        return out

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready; NaN as null."""
        values = {
            "sequences": [{"name": c.name, "young_kpa": c.young_kpa} | c.as_row() for c in self.clips],
            "summary": self.summary(),
            "intervals": {k: {"low": i.low, "high": i.high} for k, i in self.intervals().items()},
        }
        return dict(as_plain(values))


def _mean(values: Sequence[float]) -> float:
    finite = [v for v in values if math.isfinite(v)]
    return float(np.mean(finite)) if finite else math.nan


def evaluate(
    predictor: Predictor, clips: Sequence[Clip], source: str, report: ProgressCallback = lambda done, of: None
) -> EvaluationReport:
    """Scores a model on clips, with displacement from `source`, as in `learn.data.clips.FIELDS`."""
    scores = []
    for i, clip in enumerate(clips):
        report(i, len(clips))
        shift = np.asarray(clip.displacement[source])
        density = predictor.density(shift, clip.mask, clip.young_kpa, clip.confidence_of(source))
        scores.append(score(clip, density, predictor.card))
    report(len(clips), len(clips))
    return EvaluationReport(scores)
