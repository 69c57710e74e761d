"""How far what a frame shows lies from everything that was fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import FiniteFloat

from learn.uncertainty.conformal import quantile, share_quantile
from learn.uncertainty.features import is_moving
from synth.job.types import Positive

Floats = NDArray[np.float64]

USUAL = 0.99
"""Share of held-out frames that are no further than `OutOfDistribution.usual`."""
UNSEEN = "unseen world"
"""How `describe_out_of_distribution` begins."""
_MOST, _FRAMES = 0.95, 0.9  # share of recordings that are no unseen world, and of the frames that say how far
_LEAST_SPREAD = 0.05  # of a feature: logarithms and shares tell no worlds apart by less


@dataclass(frozen=True)
class OutOfDistribution:
    """The features of the fitted sequences, as one ellipsoid."""

    middle: tuple[FiniteFloat, ...]
    precision: tuple[tuple[FiniteFloat, ...], ...]
    """(F, F), inverse covariance."""
    usual: Positive
    """Distance that 99% of held-out frames stay within, every sequence weighing alike."""
    limit: Positive = 1.0
    """`recording_distance` that 95% of held-out recordings stay within."""

    def distance(self, motion: Floats) -> Floats:
        """(T,) Mahalanobis distance of frames (T, F) of `motion_features`; 0 of those that hardly moved."""
        off = motion - np.array(self.middle)
        squared = np.einsum("ti,ij,tj->t", off, np.array(self.precision), off)
        return np.where(is_moving(motion), np.sqrt(np.maximum(squared, 0)), 0.0)

    def relative_distance(self, motion: Floats) -> Floats:
        """(T,) `distance` over what 99% of held-out frames stay within."""
        return self.distance(motion) / self.usual

    def recording_distance(self, motion: Floats) -> float:
        """`relative_distance` that a tenth of a recording's frames (T, F) exceed; 0 if nothing moved."""
        moved = self.relative_distance(motion)[is_moving(motion)]
        return float(np.quantile(moved, _FRAMES)) if len(moved) else 0.0

    def calibrated(self, recordings: Sequence[Floats]) -> OutOfDistribution:
        """The same with its `limit`, from `motion_features` (T, F) of recordings that were not fitted.

        Of fewer than 19 that moved no bound is known: it is the furthest of them.
        """
        far = [np.array([self.recording_distance(one)]) for one in recordings if is_moving(one).any()]
        limit = quantile(far, _MOST)
        return replace(self, limit=max(limit if np.isfinite(limit) else np.max(far), 1e-6))

    def widening(self, motion: Floats) -> Floats:
        """(T,) what intervals are multiplied by: how many times further than usual a frame is, 1 at least."""
        return np.maximum(self.relative_distance(motion), 1.0)


def fit_distribution(fitted: Sequence[Floats], held_out: Sequence[Floats]) -> OutOfDistribution | None:
    """The ellipsoid of the moving frames of the fitted sequences; None if either hold none.

    Covariance with the shrinkage of Ledoit and Wolf (2004), on features of unit variance.

    Args:
        fitted: `motion_features` of each sequence, (T, F).
        held_out: the same of sequences that were not fitted.
    """
    moved = [motion[is_moving(motion)] for motion in fitted]
    others = [motion for motion in held_out if is_moving(motion).any()]
    if sum(map(len, moved)) < 2 or not others:
        return None
    seen = np.concatenate(moved)
    spread = np.maximum(seen.std(0), _LEAST_SPREAD)
    shrunk = shrunk_covariance(seen / spread)
    # Where nothing varied there is no variance to invert.
    least = (_LEAST_SPREAD / spread) ** 2
    precision = np.linalg.inv(shrunk + np.diag(np.maximum(least - np.diag(shrunk), 0.0)))
    precision = precision / np.outer(spread, spread)
    fitted_to = OutOfDistribution(tuple(seen.mean(0).tolist()), tuple(map(tuple, precision.tolist())), 1.0)
    usual = share_quantile([fitted_to.distance(m)[is_moving(m)] for m in others], USUAL)
    return replace(fitted_to, usual=max(usual, 1e-6))


def shrunk_covariance(samples: Floats) -> Floats:
    """(F, F) covariance of (n, F) samples, drawn towards a multiple of the identity as far as its noise asks.

    Ledoit & Wolf, "A well-conditioned estimator for large-dimensional covariance matrices", J. Multivar.
    Anal. 88, 2004.
    """
    count, parts = samples.shape
    centred = samples - samples.mean(0)
    plain = centred.T @ centred / count
    mean = np.trace(plain) / parts
    away = float(((plain - mean * np.eye(parts)) ** 2).sum())
    noise = float(((centred**2).sum(1) ** 2).mean() - (plain**2).sum()) / count
    share = min(noise / away, 1.0) if away > 0 else 0.0
    return np.asarray((1 - share) * plain + share * mean * np.eye(parts))


def describe_out_of_distribution(world: OutOfDistribution, names: Sequence[str], motion: Floats) -> list[str]:
    """A line for a person if a recording is further from what was fitted than 95% of held-out ones.

    Args:
        names: of the features.
        motion: (T, F) `motion_features` of the frames that could be followed.
    """
    far = world.recording_distance(motion)
    if not far > world.limit:
        return []
    off = motion[world.relative_distance(motion) >= far] - np.array(world.middle)
    parts = (off * (off @ np.array(world.precision))).mean(0)
    # Those that make up half of it; a square form has no better way to be shared out.
    order = np.argsort(-parts)
    most = order[: 1 + int(np.argmax(np.cumsum(parts[order]) >= parts.sum() / 2))]
    named = " and ".join(f"{names[k]} ({'high' if off[:, k].mean() > 0 else 'low'})" for k in most)
    return [
        f"{UNSEEN}: it moves unlike anything that the network was trained on, most of all in {named}: "
        f"{far / world.limit:.2g} times as far away as 95% of recordings are at most; intervals are widened, "
        "and may still be too narrow"
    ]
