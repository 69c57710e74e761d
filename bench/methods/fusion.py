"""Network and physics as one estimate, each weighed by its stated error.

The estimate of physics is a mixture over contacts and tissues. The network's is one more observation of the
same force: it draws each component towards itself, and those that it contradicts lose weight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bench.methods.force_mixture import size_interval
from bench.methods.protocol import Field, ForceEstimate, MethodContext, widen_small_forces
from synth.errors import UserError

# Both are chosen on even sequences of mission-ood; odd ones: docs/results/scoring/fusion.
_COMMON = 0.3  # relative deviation of what both err by alike
_CAUTION = 1.5  # factor of the network's stated deviation: recordings are less like its training


class Fusion:
    """Two methods of the table that state their errors, as one; see the module."""

    def __init__(self, network: str, physics: str) -> None:
        """Names of the two."""
        self.parts = network, physics
        self._share, self._alone = 0.0, 0

    def __call__(self, flow: Field, confidence: Field, scene: MethodContext, picture: bool) -> ForceEstimate:
        """Raises UserError: it has no estimate of its own."""
        raise UserError(f"a fusion of {' and '.join(self.parts)} needs their estimates: score it with them")

    def fuse(
        self, answers: Sequence[Mapping[str, ForceEstimate]], scene: MethodContext, eyes: int
    ) -> list[ForceEstimate]:
        """See `FusedEstimate`; where one states no error the network's estimate stands alone."""
        gain = float(np.hypot(_COMMON, scene.young_uncertainty))
        found, pulled, apart, self._alone = list[ForceEstimate](), 0.0, 0.0, 0
        for frame in answers:
            network, physics = (frame[name] for name in self.parts)
            if network.likely is None or physics.likely is None:
                found.append(replace(network, likely=None))
                self._alone += 1
                continue
            spread = _CAUTION**2 * network.likely.covariance[0]
            both = physics.likely.observe(network.likely.mean, spread)
            found.append(ForceEstimate(both.mean, None, *size_interval(both, gain, eyes)))
            off = network.force_mn - physics.force_mn
            pulled, apart = pulled + float((both.mean - physics.force_mn) @ off), apart + float(off @ off)
        self._share = pulled / apart if apart else 0.0
        return widen_small_forces(found)

    @property
    def notes(self) -> list[str]:
        """What each weighed over the film."""
        network, physics = self.parts
        if self._alone:
            return [f"{self._alone} frames are of {network} alone: one of the two states no error"]
        return [f"where they differ {network} weighs {self._share:.0%} and {physics} {1 - self._share:.0%}"]
