"""How wrong a flow is: endpoint error, magnitude, divergence; and the estimators under test by name."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from evidence.flow.scenes import Flags, Floats, Pair, Rgb
from synth.flow.estimator import Estimator

_SIGMA = 1.0  # px: divergence is compared after this Gaussian, on both sides


@dataclass(frozen=True)
class Error:
    """One flow against the truth, or the mean over many. Lengths in px."""

    mean: float
    """Endpoint error over what is seen."""
    p95: float
    contact: float
    """Endpoint error within the contact, hidden points included."""
    contact_seen: float
    """The same where it is seen."""
    hidden: float
    """Endpoint error under the tool; NaN where nothing is hidden."""
    magnitude: float
    """Mean error of |flow| as a share of the mean |flow|, over what is seen."""
    divergence: float
    """RMS error of the divergence relative to its RMS, over what is seen."""
    divergence_r: float
    """Correlation of found and true divergence."""
    cpu_s: float
    """Processor time."""


def epe(flow: Floats, truth: Floats) -> Floats:
    """Endpoint error, (H, W) px (Baker et al., IJCV 2011)."""
    return np.asarray(np.linalg.norm(flow - truth, axis=-1), np.float32)


def divergence(flow: Floats) -> Floats:
    """d u/d x + d v/d y after a Gaussian of 1 px, (H, W)."""
    smooth = cv2.GaussianBlur(flow, (0, 0), _SIGMA)
    return np.asarray(np.gradient(smooth[..., 0], axis=1) + np.gradient(smooth[..., 1], axis=0), np.float32)


def against(flow: Floats, truth: Floats, seen: Flags, contact: Flags, hidden: Flags, cpu_s: float) -> Error:
    """Errors of one flow. seen, contact, hidden: (H, W)."""
    error = epe(flow, truth)
    size, real = np.linalg.norm(flow, axis=-1)[seen], np.linalg.norm(truth, axis=-1)[seen]
    found, true = divergence(flow)[seen], divergence(truth)[seen]
    spread = float(np.sqrt(np.mean(true**2)))
    return Error(
        mean=float(error[seen].mean()),
        p95=float(np.percentile(error[seen], 95)),
        contact=_within(error, contact),
        contact_seen=_within(error, contact & seen),
        hidden=_within(error, hidden),
        magnitude=float(np.abs(size - real).mean() / max(float(real.mean()), 1e-9)),
        divergence=float(np.sqrt(np.mean((found - true) ** 2)) / max(spread, 1e-9)),
        divergence_r=float(np.corrcoef(found, true)[0, 1]) if spread > 0 and found.std() > 0 else 0.0,
        cpu_s=cpu_s,
    )


def _within(error: Floats, where: Flags) -> float:
    return float(error[where].mean()) if where.any() else float("nan")


Masks = Callable[[Rgb, Flags], Flags]
"""(picture, exact mask of what is usable) → the mask to use."""


def exact(_: Rgb, usable: Flags) -> Flags:
    """The mask as given."""
    return usable


def measure(
    estimator: Estimator, pairs: Iterable[Pair], masks: Masks = exact, warm: float | None = None
) -> Error:
    """Mean errors over pairs.

    Args:
        estimator: under test.
        pairs: with truth.
        masks: what stands for the exact masks.
        warm: start from this share of the true flow, as the frame before would give; None: cold.
    """
    errors = []
    for pair in pairs:
        initial = None if warm is None else warm * pair.flow
        rest, now = masks(pair.rest, pair.rest_usable), masks(pair.now, pair.now_usable)
        begin = time.process_time()
        flow, _ = estimator.flow(pair.rest, pair.now, rest, now, initial)
        spent = time.process_time() - begin
        seen = pair.inside & ~pair.hidden
        errors.append(against(flow, pair.flow, seen, pair.contact, pair.hidden, spent))
    return average(errors)


def average(errors: Sequence[Error]) -> Error:
    """Mean of each figure; of the time, the median, which other work on the machine disturbs least."""
    table = {name: [asdict(error)[name] for error in errors] for name in asdict(errors[0])}
    means = {name: _mean(values) for name, values in table.items()}
    return Error(**{**means, "cpu_s": float(np.median(table["cpu_s"]))})


def _mean(values: Sequence[float]) -> float:
    good = np.asarray(values, float)
    good = good[np.isfinite(good)]
    return float(good.mean()) if len(good) else float("nan")


class MeanInpainting:
    """An estimator given pictures whose masked pixels hold the mean intensity, as the paper has it."""

    def __init__(self, estimator: Estimator) -> None:
        self.estimator = estimator

    def flow(
        self, rest: Rgb, now: Rgb, rest_usable: Flags, now_usable: Flags, initial: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """See `Estimator.flow`; the estimator itself is told that everything is usable."""
        every = np.ones_like(rest_usable)
        return self.estimator.flow(
            _inpaint(rest, rest_usable), _inpaint(now, now_usable), every, every, initial
        )


def _inpaint(picture: Rgb, usable: Flags) -> Rgb:
    mean: NDArray[np.float64] = picture[usable].mean(axis=0) if usable.any() else np.full(3, 128.0)
    return np.where(usable[..., None], picture, np.round(mean)).astype(np.uint8)
