"""What an estimator of displacement is, and the ones there are by name."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from synth.plugins import ESTIMATORS

Rgb = NDArray[np.uint8]
"""(H, W, 3) uint8, sRGB."""
Flags = NDArray[np.bool_]
"""(H, W)."""
Flow = NDArray[np.float32]
"""(H, W, 2) float32, px: x right, y down."""
Map = NDArray[np.float32]
"""(H, W) float32."""


class Estimator(Protocol):
    """Displacement of material points between two pictures."""

    def flow(
        self, rest: Rgb, now: Rgb, rest_usable: Flags, now_usable: Flags, initial: Flow | None = None
    ) -> tuple[Flow, Map]:
        """Flow from `rest` to `now` at the pixel centres of `rest`.

        Args:
            rest: (H, W, 3) uint8, sRGB.
            now: (H, W, 3) uint8, sRGB.
            rest_usable: (H, W), False where `rest` shows no tissue (tool, glare, outside).
            now_usable: (H, W), the same on the pixels of `now`.
            initial: (H, W, 2) px, a guess to start from.

        Returns:
            Flow (H, W, 2) float32 px, finite everywhere, and confidence (H, W) float32 in 0..1.
        """
        ...


def create(name: str) -> Estimator:
    """Makes the estimator called `name`: one of ours, or one from the entry-point group `sulcus.flow`.

    Raises:
        UserError: no such estimator, or a plug-in's package that does not load.
    """
    estimator: Estimator = ESTIMATORS.load(name)
    return estimator
