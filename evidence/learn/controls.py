"""What must score nothing, and what must score everything: checks on the scoring, not on the network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from learn.checkpoint import Card
from learn.data.clips import Clip, target
from learn.evaluation.evaluate import ClipScore, Report, evaluate, score
from learn.evaluation.statistics import skill
from learn.inference.predict import Predictor
from learn.settings import replace as changed

KEYS = (
    "map_r2_pooled",
    "force_r2_pooled",
    "map_rmse",
    "force_mae",
    "ghost_relative",
    "ghost_far",
    "stray_mn",
)


def controls(
    predictor: Predictor, clips: Sequence[Clip], source: str, fit: Sequence[Clip]
) -> dict[str, dict[str, float]]:
    """Summaries of a trained model's controls on clips it has not seen.

    `zero`: the model is shown no motion (R² at most 0). `identity`: the truth itself is scored as the answer
    (every error 0, R² 1). `input`: the size of the displacement, times the factor that fits the clips best,
    taken for the force map (what can be had without learning). `mean map`: the mean over all frames of `fit`
    and their turns, times E (what can be had without looking at the motion: where contacts lie, and E).
    """
    still = [replace(c, displacement={k: 0 * v for k, v in c.displacement.items()}) for c in clips]
    found = {
        "zero": evaluate(predictor, still, source),
        "identity": _truth(clips, predictor.card),
        "input": _moved(clips, predictor.card, source),
        "mean map": mean_map(clips, predictor.card, fit),
    }
    return {name: {k: report.summary()[k] for k in KEYS} for name, report in found.items()}


def mean_map(clips: Sequence[Clip], card: Card, fit: Sequence[Clip]) -> Report:
    """The answer to any motion: the fitted frames' mean map, over its eight turns as in training, times E.

    A network that was trained on labels dealt out anew can say this much and no more.
    """
    plain = _of_lengths(card)
    sums = np.zeros(fit[0].mask.shape)
    tissue = np.zeros_like(sums)
    for clip in fit:
        sums += _maps(clip, plain).sum((0, 1), dtype=np.float64) / clip.young_kpa
        tissue += clip.frames * np.asarray(clip.mask)
    turns = [np.rot90(side, k) for side in (sums, sums[:, ::-1]) for k in range(4)]
    count = sum(np.rot90(side, k) for side in (tissue, tissue[:, ::-1]) for k in range(4))
    mean = np.divide(sum(turns), count, out=np.zeros_like(sums), where=count > 0)
    said = [
        np.broadcast_to((mean * c.mask * c.young_kpa).astype(np.float32), (c.frames, 1, *c.mask.shape))
        for c in clips
    ]
    return Report({"known": [score(c, s, plain) for c, s in zip(clips, said, strict=True)]}, plain)


def beyond_mean_map(report: Report, base: Report) -> dict[str, dict[str, float]]:
    """What an answer knows beyond the mean map and E: 1 − SSE/SSE of `mean_map`, of the map and of the force.

    Labels dealt out anew must score 0 here; their R² needn't be, for a mean map with the right E has one.
    """
    found = {}
    for name, errors in (("map", _map_sse), ("force", _force_sse)):
        own, other = (np.array([errors(c) for c in r.clips]) for r in (report, base))
        i = skill(own, other, np.random.default_rng(0))
        found[name] = {"mean": i.mean, "low": i.low, "high": i.high}
    return found


def _map_sse(c: ClipScore) -> float:
    return c.map.tt - 2 * c.map.tp + c.map.pp


def _force_sse(c: ClipScore) -> float:
    return float(np.square(c.said_mn - c.true_mn).sum())


def _maps(clip: Clip, card: Card) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    kind, parts = card.settings.target, card.settings.arch.components
    return np.stack([target(clip, t, kind, parts) for t in range(clip.frames)]) * np.float32(clip.young_kpa)


def _truth(clips: Sequence[Clip], card: Card) -> Report:
    return Report({"known": [score(c, _maps(c, card), card) for c in clips]}, card)


def _of_lengths(card: Card) -> Card:
    """A card whose maps are lengths."""
    arch = changed(card.settings.arch, output="magnitude")
    return replace(card, settings=changed(card.settings, arch=arch))


def _moved(clips: Sequence[Clip], card: Card, source: str) -> Report:
    sizes = [np.linalg.norm(c.displacement[source], axis=1, keepdims=True) * c.young_kpa for c in clips]
    true = [np.linalg.norm(_maps(c, card), axis=1, keepdims=True) for c in clips]
    over, under = (
        sum(float((s.astype(np.float64) * v).sum()) for s, v in zip(sizes, other, strict=True))
        for other in (true, sizes)
    )
    plain = _of_lengths(card)
    said = [(s * (over / under)).astype(np.float32) for s in sizes]
    return Report({"known": [score(c, s, plain) for c, s in zip(clips, said, strict=True)]}, plain)
