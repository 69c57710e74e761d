"""Out-of-distribution detection: distance of a recording's motion from the training sequences'."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import FiniteFloat

from learn.uncertainty.conformal import quantile, weighted_quantile
from learn.uncertainty.features import is_moving
from synth.arrays import Floats
from synth.job.types import Positive

FRAMES = 0.99  # share of held-out frames within `MotionDistribution.frame_limit`
RECORDINGS = 0.95  # share of held-out recordings within `MotionDistribution.recording_limit`
OUT_OF_DISTRIBUTION = "out of distribution"  # first words of `describe_out_of_distribution`
_QUANTILE = 0.9  # of the frames' distances in a recording, which is the recording's distance
_LEAST_SPREAD = 0.05  # least standard deviation of a feature; smaller differences don't matter


@dataclass(frozen=True)
class MotionDistribution:
    """Distribution of the training sequences' `motion_features`, as mean and covariance."""

    mean: tuple[FiniteFloat, ...]
    precision: tuple[tuple[FiniteFloat, ...], ...]  # (F, F), inverse covariance
    frame_limit: Positive  # distance of 99% of held-out frames at most, sequences weighted equally
    recording_limit: Positive = 1.0  # `recording_distance` of 95% of held-out recordings at most

    def distance(self, motion: Floats) -> Floats:
        """(T,) Mahalanobis distance of frames (T, F) of `motion_features`; 0 for frames at rest."""
        deviation = motion - np.array(self.mean)
        squared = np.einsum("ti,ij,tj->t", deviation, np.array(self.precision), deviation)
        return np.where(is_moving(motion), np.sqrt(np.maximum(squared, 0)), 0.0)

    def relative_distance(self, motion: Floats) -> Floats:
        """(T,) `distance` in units of `frame_limit`."""
        return self.distance(motion) / self.frame_limit

    def recording_distance(self, motion: Floats) -> float:
        """`relative_distance` that a tenth of a recording's moving frames exceed; 0 if none moves."""
        distances = self.relative_distance(motion)[is_moving(motion)]
        return float(np.quantile(distances, _QUANTILE)) if len(distances) else 0.0

    def calibrate(self, recordings: Sequence[Floats]) -> MotionDistribution:
        """A copy with `recording_limit` from `motion_features` (T, F) of held-out recordings: with fewer than
        19 moving ones the largest of their distances."""
        distances = [
            np.array([self.recording_distance(recording)])
            for recording in recordings
            if is_moving(recording).any()
        ]
        limit = quantile(distances, RECORDINGS)
        return replace(self, recording_limit=max(limit if np.isfinite(limit) else np.max(distances), 1e-6))


def fit_distribution(fitted: Sequence[Floats], held_out: Sequence[Floats]) -> MotionDistribution | None:
    """Distribution of the moving frames of training sequences; None if either argument has none.

    `fitted`, `held_out`: `motion_features` (T, F) of each training sequence and of each other one.
    """
    moving_frames = [motion[is_moving(motion)] for motion in fitted]
    others = [motion for motion in held_out if is_moving(motion).any()]
    if sum(map(len, moving_frames)) < 2 or not others:
        return None
    frames = np.concatenate(moving_frames)
    spread = np.maximum(frames.std(0), _LEAST_SPREAD)
    shrunk = shrunk_covariance(frames / spread)
    # A least variance for features that don't vary, so that the covariance can be inverted.
    least = (_LEAST_SPREAD / spread) ** 2
    precision = np.linalg.inv(shrunk + np.diag(np.maximum(least - np.diag(shrunk), 0.0)))
    precision = precision / np.outer(spread, spread)
    distribution = MotionDistribution(
        tuple(frames.mean(0).tolist()), tuple(map(tuple, precision.tolist())), 1.0
    )
    distances = [distribution.distance(motion)[is_moving(motion)] for motion in others]
    limit = weighted_quantile(distances, 1.0, FRAMES * len(distances))
    return replace(distribution, frame_limit=max(limit, 1e-6))


def shrunk_covariance(samples: Floats) -> Floats:
    """(F, F) covariance of (n, F) samples, shrunk towards a multiple of the identity: Ledoit & Wolf, "A
    well-conditioned estimator for large-dimensional covariance matrices", J. Multivar. Anal. 88, 2004."""
    count, parts = samples.shape
    centred = samples - samples.mean(0)
    plain = centred.T @ centred / count
    mean = np.trace(plain) / parts
    dispersion = float(((plain - mean * np.eye(parts)) ** 2).sum())
    noise = float(((centred**2).sum(1) ** 2).mean() - (plain**2).sum()) / count
    share = min(noise / dispersion, 1.0) if dispersion > 0 else 0.0
    return np.asarray((1 - share) * plain + share * mean * np.eye(parts))


def describe_out_of_distribution(
    distribution: MotionDistribution, names: Sequence[str], motion: Floats
) -> list[str]:
    """A warning if a recording, by the features (T, F) of its tracked frames, is further from the training
    data than 95% of held-out ones, else none."""
    distance = distribution.recording_distance(motion)
    if not distance > distribution.recording_limit:
        return []
    deviation = motion[distribution.relative_distance(motion) >= distance] - np.array(distribution.mean)
    parts = (deviation * (deviation @ np.array(distribution.precision))).mean(0)
    # The features with the largest parts in the squared distance, which together are half of it.
    order = np.argsort(-parts)
    largest = order[: 1 + int(np.argmax(np.cumsum(parts[order]) >= parts.sum() / 2))]
    causes = " and ".join(f"{names[k]} ({'high' if deviation[:, k].mean() > 0 else 'low'})" for k in largest)
    return [
        f"{OUT_OF_DISTRIBUTION}: the motion differs from the training data's, most in {causes}; its distance "
        f"is {distance / distribution.recording_limit:.2g} times that of 95% of recordings at most; "
        "intervals are widened and may still be too narrow"
    ]
