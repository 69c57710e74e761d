"""The result of a check: a number, its limit, and its place."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from synth.arrays import Mask
from synth.dataset.store import Sequence


@dataclass(frozen=True)
class Measure:
    """A number that must not exceed its limit, and its place in the dataset."""

    value: float
    limit: float
    place: str
    unit: str = "-"  # of value and limit

    @property
    def good(self) -> bool:
        return bool(self.value <= self.limit)

    @property
    def severity(self) -> float:
        """Value relative to the limit, above 1 if bad; compares measures with different limits."""
        if self.limit > 0:
            return self.value / self.limit
        return 0.0 if self.good else np.inf


@dataclass(frozen=True)
class Nothing:
    """A sequence in which there is nothing to measure."""

    why: str


Invariant = Callable[[Sequence, list[int]], Iterator[Measure | Nothing]]
"""Measures of a sequence in some frames, or the reason why there is none."""


def truth(good: bool, place: str) -> Measure:
    """A measure of a condition that holds or not."""
    return Measure(0.0 if good else 1.0, 0.0, place)


def inner(mask: Mask, pixels: int) -> Mask:
    """The mask (H, W) eroded by `pixels`, also at the edge of the picture."""
    side = 2 * pixels + 1
    core = cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=0)
    return np.asarray(core, bool)
