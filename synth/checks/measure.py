"""What a check finds: a number, the limit that it must keep, and where."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.dataset.store import Sequence


@dataclass(frozen=True)
class Measure:
    """One number that must not exceed its limit, and where it was found."""

    value: float
    limit: float
    where: str
    unit: str = "-"
    """Of value and limit."""

    @property
    def good(self) -> bool:
        return bool(self.value <= self.limit)

    @property
    def severity(self) -> float:
        """Above 1 is bad; compares measures whose limits differ."""
        if self.limit > 0:
            return self.value / self.limit
        return 0.0 if self.good else np.inf


Invariant = Callable[[Sequence, list[int]], Iterator[Measure]]
"""Measures of a sequence in the frames given."""


def truth(good: bool, where: str) -> Measure:
    """A measure of what either holds or not."""
    return Measure(0.0 if good else 1.0, 0.0, where)


def inner(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """The mask (H, W) without the `pixels` next to its edge and the picture's."""
    side = 2 * pixels + 1
    core = cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=0)
    return np.asarray(core, bool)
