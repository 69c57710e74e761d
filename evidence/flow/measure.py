"""Errors of a flow: endpoint error, magnitude, divergence."""

import time
from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from evidence.flow.scenes import Pair
from synth.arrays import Array, Map, Mask
from synth.flow.estimator import Estimator
from synth.flow.segmentation import segment

Errors = dict[str, float]
_JACCARD_PX = 2, 4, 8, 16, 32
_SIGMA = 1.0  # px: divergence is compared after this Gaussian, on both sides


def epe(flow: Map, truth: Map) -> Map:
    """Endpoint error, (H, W) px (Baker et al., IJCV 2011)."""
    return np.asarray(np.linalg.norm(flow - truth, axis=-1), np.float32)


def average_jaccard(error: Map, tracked: Mask, visible: Mask) -> float:
    """Average Jaccard of tracked points (C. Doersch et al., TAP-Vid, NeurIPS 2022) at STIR's thresholds.

    `error`: endpoint error [px] of any shape; `tracked`, `visible`: whether points are tracked and visible.
    """
    shares = []
    for threshold in _JACCARD_PX:
        correct = tracked & visible & (error < threshold)
        shares.append(
            correct.sum() / max(1, np.count_nonzero(visible) + np.count_nonzero(tracked & ~correct))
        )
    return float(np.mean(shares))


def divergence(flow: Map) -> Map:
    """d u/d x + d v/d y after a Gaussian of 1 px, (H, W)."""
    smooth = cv2.GaussianBlur(flow, (0, 0), _SIGMA)
    return np.asarray(np.gradient(smooth[..., 0], axis=1) + np.gradient(smooth[..., 1], axis=0), np.float32)


def errors(flow: Map, pair: Pair) -> Errors:
    """Errors of one flow (H, W, 2) px. Lengths in px, NaN without such pixels.

    Returns:
        Endpoint error: `mean` over visible pixels, and `still`, that of no flow; `contact`, hidden points
        included; `contact_visible`, without them; `hidden` under the tool. `magnitude`: mean error of |flow|
        relative to the mean |flow|;
        `divergence`: its RMS error relative to its RMS, `divergence_r`: its correlation with the true one,
        over visible pixels.
    """
    error, visible = epe(flow, pair.flow), pair.inside & ~pair.hidden
    lengths, true_lengths = (np.linalg.norm(field, axis=-1)[visible] for field in (flow, pair.flow))
    recovered, true = divergence(flow)[visible], divergence(pair.flow)[visible]
    spread = float(np.sqrt(np.mean(true**2)))
    return {
        "mean": float(error[visible].mean()),
        "still": float(true_lengths.mean()),
        "contact": _mean(error[pair.contact]),
        "contact_visible": _mean(error[pair.contact & visible]),
        "hidden": _mean(error[pair.hidden]),
        "magnitude": float(np.abs(lengths - true_lengths).mean() / max(float(true_lengths.mean()), 1e-9)),
        "divergence": float(np.sqrt(np.mean((recovered - true) ** 2)) / max(spread, 1e-9)),
        "divergence_r": float(np.corrcoef(recovered, true)[0, 1])
        if spread > 0 and recovered.std() > 0
        else 0.0,
    }


def mean_errors(
    estimator: Estimator, pairs: Iterable[Pair], detected: bool = False, warm: float | None = None
) -> Errors:
    """Mean `errors` over pairs, and median CPU time [s] as `cpu_s`: other processes disturb it least.

    `detected`: with masks detected in the images, not the exact ones; `warm`: start from this share of the
    true flow, as from the previous frame; None: cold start.
    """
    rows = []
    for pair in pairs:
        rest, now = pair.rest_usable, pair.now_usable
        if detected:
            rest, now = (~segment(pair.rest, picture).hidden for picture in (pair.rest, pair.now))
        initial = None if warm is None else warm * pair.flow
        begin = time.process_time()
        flow, _ = estimator.flow(pair.rest, pair.now, rest, now, initial)
        rows.append({"cpu_s": time.process_time() - begin} | errors(flow, pair))
    means = {name: _mean([row[name] for row in rows]) for name in rows[0]}
    return means | {"cpu_s": float(np.median([row["cpu_s"] for row in rows]))}


def _mean(values: Sequence[float] | Array) -> float:
    finite = np.asarray(values)
    finite = finite[np.isfinite(finite)]
    return float(finite.mean()) if len(finite) else float("nan")
