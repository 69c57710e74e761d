"""What must score nothing, and what must score everything: checks on the scoring, not on the network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from learn.checkpoint import Card
from learn.data import Clip, target
from learn.evaluate import Report, evaluate, score
from learn.predict import Predictor

KEYS = (
    "map_r2_pooled",
    "force_r2_pooled",
    "map_rmse",
    "force_mae",
    "ghost_relative",
    "ghost_far",
    "stray_mn",
)


def controls(predictor: Predictor, clips: Sequence[Clip], source: str) -> dict[str, dict[str, float]]:
    """Summaries of a trained model's controls on clips it has not seen.

    `zero`: the model is shown no motion (R² at most 0). `identity`: the truth itself is scored as the answer
    (every error 0, R² 1). `input`: the size of the displacement, times the factor that fits the clips best,
    taken
    for the force map (what can be had without learning).
    """
    still = [replace(c, displacement={k: 0 * v for k, v in c.displacement.items()}) for c in clips]
    found = {
        "zero": evaluate(predictor, still, source),
        "identity": _truth(clips, predictor.card),
        "input": _moved(clips, predictor.card, source),
    }
    return {name: {k: report.summary()[k] for k in KEYS} for name, report in found.items()}


def _maps(clip: Clip, card: Card) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    kind, parts = card.settings.target, card.settings.arch.components
    return np.stack([target(clip, t, kind, parts) for t in range(clip.frames)]) * np.float32(clip.young_kpa)


def _truth(clips: Sequence[Clip], card: Card) -> Report:
    return Report({"known": [score(c, _maps(c, card), card) for c in clips]}, card)


def _moved(clips: Sequence[Clip], card: Card, source: str) -> Report:
    sizes = [np.linalg.norm(c.displacement[source], axis=1, keepdims=True) * c.young_kpa for c in clips]
    true = [np.linalg.norm(_maps(c, card), axis=1, keepdims=True) for c in clips]
    over, under = (
        sum(float((s.astype(np.float64) * v).sum()) for s, v in zip(sizes, other, strict=True))
        for other in (true, sizes)
    )
    plain = replace(
        card, settings=replace(card.settings, arch=replace(card.settings.arch, output="magnitude"))
    )
    said = [(s * (over / under)).astype(np.float32) for s in sizes]
    return Report({"known": [score(c, s, plain) for c, s in zip(clips, said, strict=True)]}, plain)
