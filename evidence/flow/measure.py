"""Errors of a flow: endpoint error, magnitude, divergence."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass

import cv2
import numpy as np

from evidence.flow.scenes import Pair
from synth.arrays import Array, Map, Mask, Pixels
from synth.flow.estimator import Estimator

_SIGMA = 1.0  # px: divergence is compared after this Gaussian, on both sides


@dataclass(frozen=True)
class Error:
    """Errors of one flow, or means over several. Lengths in px; NaN without such pixels."""

    mean: float  # endpoint error over visible pixels
    p95: float
    contact: float  # endpoint error within the contact, hidden points included
    contact_visible: float  # the same without hidden points
    hidden: float  # endpoint error under the tool
    glare: float  # endpoint error over visible pixels that are highlights in the rest frame
    magnitude: float  # mean error of |flow| relative to the mean |flow|, over visible pixels
    divergence: float  # RMS error of the divergence relative to its RMS, over visible pixels
    divergence_r: float  # correlation of estimated and true divergence
    cpu_s: float  # processor time


def epe(flow: Map, truth: Map) -> Map:
    """Endpoint error, (H, W) px (Baker et al., IJCV 2011)."""
    return np.asarray(np.linalg.norm(flow - truth, axis=-1), np.float32)


def divergence(flow: Map) -> Map:
    """d u/d x + d v/d y after a Gaussian of 1 px, (H, W)."""
    smooth = cv2.GaussianBlur(flow, (0, 0), _SIGMA)
    return np.asarray(np.gradient(smooth[..., 0], axis=1) + np.gradient(smooth[..., 1], axis=0), np.float32)


def against(flow: Map, pair: Pair, cpu_s: float) -> Error:
    """Errors of one flow, (H, W, 2) px."""
    error, visible = epe(flow, pair.flow), pair.inside & ~pair.hidden
    size, real = np.linalg.norm(flow, axis=-1)[visible], np.linalg.norm(pair.flow, axis=-1)[visible]
    found, true = divergence(flow)[visible], divergence(pair.flow)[visible]
    spread = float(np.sqrt(np.mean(true**2)))
    return Error(
        mean=float(error[visible].mean()),
        p95=float(np.percentile(error[visible], 95)),
        contact=_mean(error[pair.contact]),
        contact_visible=_mean(error[pair.contact & visible]),
        hidden=_mean(error[pair.hidden]),
        glare=_mean(error[visible & ~pair.rest_usable]),
        magnitude=float(np.abs(size - real).mean() / max(float(real.mean()), 1e-9)),
        divergence=float(np.sqrt(np.mean((found - true) ** 2)) / max(spread, 1e-9)),
        divergence_r=float(np.corrcoef(found, true)[0, 1]) if spread > 0 and found.std() > 0 else 0.0,
        cpu_s=cpu_s,
    )


Masks = Callable[[Pixels, Mask], Mask]  # (image, exact mask of usable pixels) → the mask to use


def mean_error(
    estimator: Estimator, pairs: Iterable[Pair], masks: Masks | None = None, warm: float | None = None
) -> Error:
    """Mean errors over pairs, with other masks than the exact ones if they are given.

    `warm`: start from this share of the true flow, as from the previous frame; None: cold start.
    """
    errors = []
    for pair in pairs:
        rest, now = pair.rest_usable, pair.now_usable
        if masks is not None:
            rest, now = masks(pair.rest, rest), masks(pair.now, now)
        initial = None if warm is None else warm * pair.flow
        begin = time.process_time()
        flow, _ = estimator.flow(pair.rest, pair.now, rest, now, initial)
        errors.append(against(flow, pair, time.process_time() - begin))
    table = {name: [asdict(error)[name] for error in errors] for name in asdict(errors[0])}
    # The median of the times is least disturbed by other processes.
    return Error(**{n: float(np.median(v)) if n == "cpu_s" else _mean(v) for n, v in table.items()})


def _mean(values: Sequence[float] | Array) -> float:
    good = np.asarray(values)
    good = good[np.isfinite(good)]
    return float(good.mean()) if len(good) else float("nan")
