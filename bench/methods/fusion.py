"""Network and physics as one answer: each counts as much as its own error says.

What physics holds likely of a frame is a mixture over contacts and tissues. The network's answer is one more
observation of the same force: it draws each of them towards itself, and those that it speaks against fade.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bench.methods.force_mixture import size_interval
from bench.methods.protocol import Field, ForceEstimate, MethodContext, widen_small_forces
from synth.errors import UserError

_COMMON, _CAUTION = 0.3, 1.5
"""Relative deviation of what both err by alike, which no weighing tells; and what the network's stated
deviation is multiplied by, for what comes is less like its training than what stated it
(`evidence.scoring.together`)."""


class Fusion:
    """Two methods of the table that say what they hold likely, as one; see the module."""

    def __init__(self, network: str, physics: str) -> None:
        """Names of the two."""
        self.parts = network, physics
        self._share, self._alone = 0.0, 0

    def __call__(self, flow: Field, confidence: Field, scene: MethodContext, picture: bool) -> ForceEstimate:
        """Raises UserError: it has nothing to say of a flow."""
        raise UserError(f"what {' and '.join(self.parts)} say together can't be asked for without them")

    def fuse(
        self, answers: Sequence[Mapping[str, ForceEstimate]], scene: MethodContext, eyes: int
    ) -> list[ForceEstimate]:
        """See `FusedEstimate`; where one knows nothing of its error the network answers alone."""
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
