"""Share of a gap closed by a training, and noise fitted to an estimator's error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from bench.bootstrap import Interval
from learn.data.clips import Clip
from synth.arrays import Floats, Map

_RESAMPLES = 2000


@dataclass(frozen=True)
class Gap:
    """Share of the gap closed by a training."""

    share: float | None  # G = [e(I to R') - e(R to R')] / [e(I to R') - e(I to I)]; None when undefined
    interval: Interval | None  # 95%, by resampling sequences in pairs
    undefined: str  # why there is no share; empty if there is one


def closed(
    ideal_on_unseen: Floats, trained_on_unseen: Floats, ideal_on_ideal: Floats, rng: np.random.Generator
) -> Gap:
    """Share of the gap closed, from errors on the same sequences, out of distribution.

    Args:
        ideal_on_unseen: (S,) error on recovered flow after training on ideal flow.
        trained_on_unseen: (S,) the same after the training in question.
        ideal_on_ideal: (S,) error on ideal flow after training on ideal flow.
        rng: source of the resamples.
    """
    gap = float(ideal_on_unseen.mean() - ideal_on_ideal.mean())
    picks = rng.integers(0, len(ideal_on_unseen), (_RESAMPLES, len(ideal_on_unseen)))
    below = (ideal_on_unseen - ideal_on_ideal)[picks].mean(axis=1)
    above = (ideal_on_unseen - trained_on_unseen)[picks].mean(axis=1)
    low, high = (float(q) for q in np.quantile(below, [0.025, 0.975]))
    if low <= 0 <= high or gap <= 0:
        reason = f"the gap's interval {low:.3g} to {high:.3g} touches zero: there may be none to close"
        return Gap(None, None, reason)
    share = float((ideal_on_unseen - trained_on_unseen).mean()) / gap
    ends = np.quantile(above / below, [0.025, 0.975])
    return Gap(share, (float(ends[0]), float(ends[1])), "")


@dataclass(frozen=True)
class Noise:
    """The simplest model of the error of recovered displacement: a gain, and smooth Gaussian noise."""

    gain: float  # recovered over ideal displacement
    sigma_mm: float  # standard deviation of a component
    reach_cells: float
    """Standard deviation of the Gaussian filter that reproduces the error's spatial correlation."""

    def add(self, displacement: Map, mask: Map, rng: np.random.Generator) -> Map:
        """Displacement (T, 2, N, N) mm with noise in all frames except the first, the rest frame."""
        out = self.gain * displacement
        for t in range(1, len(out)):
            for axis in range(2):
                smooth = gaussian_filter(rng.normal(size=mask.shape), self.reach_cells)
                out[t, axis] += self.sigma_mm / max(float(smooth.std()), 1e-12) * smooth
        return np.asarray(out * mask, np.float32)


def fit_noise(clips: Sequence[Clip]) -> Noise:
    """Noise of recovered displacement: gain by least squares, then spread and reach of the residual."""
    ideal, recovered = (
        [np.asarray(clip.displacement[name]) for clip in clips] for name in ("ideal", "recovered")
    )
    masks = [clip.mask for clip in clips]
    top = sum(float((i * r).sum()) for i, r in zip(ideal, recovered, strict=True))
    gain = top / max(sum(float((i * i).sum()) for i in ideal), 1e-12)
    square = neighbours = 0.0
    count = pairs = 0
    for i, r, mask in zip(ideal, recovered, masks, strict=True):
        inside = mask > 0
        error = ((r - gain * i) * mask)[1:]
        square += float(np.square(error).sum())
        count += 2 * len(error) * int(inside.sum())
        both = inside[:, 1:] & inside[:, :-1]
        neighbours += float((error[..., 1:] * error[..., :-1])[..., both].sum())
        pairs += 2 * len(error) * int(both.sum())
    variance = square / max(count, 1)
    rho = float(np.clip(neighbours / max(pairs, 1) / max(variance, 1e-12), 0.01, 0.999))
    # White noise blurred by a Gaussian of s cells has correlation exp(-1 / (4 s²)) between neighbours.
    return Noise(float(gain), float(np.sqrt(variance)), float(np.sqrt(-1 / (4 * np.log(rho)))))
