"""What an estimator of displacement is, and the ones there are by name."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError

Rgb = NDArray[np.uint8]
"""(H, W, 3) uint8, sRGB."""
Flags = NDArray[np.bool_]
"""(H, W)."""
Flow = NDArray[np.float32]
"""(H, W, 2) float32, px: x right, y down."""
Map = NDArray[np.float32]
"""(H, W) float32."""

GROUP = "sulcus.flow"
"""Entry-point group in which other packages offer estimators: name → a callable without arguments."""


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


_OWN = {
    "tvl1": ("synth.flow.tvl1", "Tvl1"),
    "opencv-tvl1": ("synth.flow.opencv", "OpenCvTvl1"),
    "dis": ("synth.flow.opencv", "Dis"),
}


def names() -> tuple[str, ...]:
    """The estimators that can be made here: our own, then the installed plug-ins'."""
    return (*_OWN, *sorted(point.name for point in entry_points(group=GROUP) if point.name not in _OWN))


def create(name: str) -> Estimator:
    """Makes the estimator called `name`: one of ours, or one from the entry-point group `sulcus.flow`.

    Raises:
        UserError: no such estimator.
    """
    maker: Any
    if name in _OWN:
        module, attribute = _OWN[name]
        maker = getattr(import_module(module), attribute)
    else:
        found = {point.name: point for point in entry_points(group=GROUP)}
        if name not in found:
            raise UserError(f"flow.backend: no estimator {name!r}; there are {', '.join(names())}")
        maker = found[name].load()
    estimator: Estimator = maker()
    return estimator
