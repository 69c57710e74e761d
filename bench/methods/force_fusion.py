"""Fusion of network and physics, each weighted by its stated error.

The network's estimate is a further observation of the force of which physics gives a mixture over contacts
and tissues: it shifts each component, and components that contradict it lose weight. It states no interval.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bench.methods.method_interface import ForceEstimate, FrameMotion, MethodContext
from synth.arrays import Floats
from synth.errors import UserError

# Chosen on even sequences of mission-ood and on foreign recordings of seed 600; results are of others.
_MOST = 100.0  # largest factor of an error that is stated too small where the force is known
# Factor of the network's stated deviation by number of cameras: recordings differ from its training data, but
# force along the optical axis hardly shows in one camera's motion, of which physics is too sure.
_CAUTION = {1: 0.25, 2: 1.5}


class Fusion:
    """The fusion of two methods that state their errors; see the module."""

    def __init__(self, network: str, physics: str) -> None:
        """Names of the two methods."""
        self.parts = network, physics
        self._share, self._alone = np.nan, 0

    def __call__(self, frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        """Raises UserError: a fusion needs the estimates of its parts."""
        raise UserError(f"a fusion of {' and '.join(self.parts)} needs their estimates: score it with them")

    def fuse(
        self,
        estimates: Sequence[Mapping[str, ForceEstimate]],
        scene: MethodContext,
        cameras: int,
        known_mn: Floats | None = None,
    ) -> list[ForceEstimate]:
        """Forces of a video's frames from the other methods' estimates; the network's where one has no error.

        `known_mn`: (T,) where it is known (free spans, press), else NaN: what fails there loses weight.
        """
        reference_mn = np.full(len(estimates), np.nan) if known_mn is None else known_mn
        factors = [_find_widening([frame[name] for frame in estimates], reference_mn) for name in self.parts]
        fusions, weighted_squares, squares, self._alone = list[ForceEstimate](), 0.0, 0.0, 0
        for frame in estimates:
            network, physics = (frame[name] for name in self.parts)
            if network.likely is None or physics.likely is None:
                fusions.append(ForceEstimate(network.force_mn))
                self._alone += 1
                continue
            covariance = (_CAUTION[cameras] * factors[0]) ** 2 * network.likely.covariance[0]
            prior = replace(physics.likely, covariance=factors[1] ** 2 * physics.likely.covariance)
            posterior = prior.observe(network.likely.mean, covariance)
            difference = network.force_mn - physics.force_mn
            square = float(difference @ difference)
            # The weight is in 0..1: components that lose weight must not move the estimate beyond both.
            share = float((posterior.mean - physics.force_mn) @ difference) / max(square, 1e-12)
            weight = min(max(share, 0.0), 1.0)
            mean = posterior.mean + (weight - share) * difference
            # What neither sees stays as likely as physics has it, however sure the network is.
            fusions.append(ForceEstimate(mean, expected_mn=prior.centre_at(mean).find_size(cameras)))
            weighted_squares, squares = weighted_squares + weight * square, squares + square
        self._share = weighted_squares / squares if squares else np.nan
        return fusions

    @property
    def notes(self) -> list[str]:
        """The weights of the two methods over the video, unless they are nowhere fused or nowhere differ."""
        if np.isnan(self._share):
            return []
        (network, physics), share = self.parts, self._share
        return [f"weights where they differ: {network} {share:.0%}, {physics} {1 - share:.0%}"]

    @property
    def warnings(self) -> list[str]:
        """Frames without a fusion."""
        message = f"{self._alone} frames use {self.parts[0]} alone: one of the two methods states no error"
        return [message] if self._alone else []


def _find_widening(estimates: Sequence[ForceEstimate], known_mn: Floats) -> float:
    """Factor of at least 1 by which a method's 90% intervals hold 90% of the known forces (T,) [mN]."""
    factors = []
    for estimate, true_mn in zip(estimates, known_mn, strict=True):
        side_mn = (
            estimate.high_mn - estimate.size_mn
            if true_mn > estimate.size_mn
            else estimate.size_mn - estimate.low_mn
        )
        if np.isfinite(true_mn) and np.isfinite(side_mn):
            factors.append(abs(true_mn - estimate.size_mn) / max(side_mn, 1e-9))
    return float(np.clip(np.quantile(factors, 0.9), 1, _MOST)) if factors else 1.0
