"""Which pixels of a frame show no tissue: glare and tool, found in the picture itself."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_CLIPPED = 240.0  # grey levels: at least two channels this high have no texture left
_ABOVE = 45.0  # grey levels above the local median
_SHRINK = 4  # the median is taken on a picture this much smaller: it is smooth


def glare(rgb: NDArray[np.uint8], dilate_px: int = 3) -> NDArray[np.bool_]:
    """Specular highlights: clearly brighter than the local median, grown by their soft rim.

    Brightness is the smallest channel: a highlight has the colour of the lamp, tissue lacks blue.

    Args:
        rgb: (H, W, 3) uint8, sRGB.
        dilate_px: growth [px].

    Returns:
        (H, W) bool, True in glare.
    """
    whiteness = rgb.min(axis=2)
    height, width = whiteness.shape
    small = cv2.resize(
        whiteness, (max(1, width // _SHRINK), max(1, height // _SHRINK)), interpolation=cv2.INTER_AREA
    )
    window = max(3, (max(height, width) // (4 * _SHRINK)) | 1)
    median = cv2.resize(cv2.medianBlur(small, window), (width, height), interpolation=cv2.INTER_LINEAR)
    bright = (whiteness.astype(np.float32) > median + _ABOVE) | (
        np.partition(rgb, 1, axis=2)[..., 1] > _CLIPPED
    )
    grown = 2 * dilate_px + 1
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (grown, grown))
    return np.asarray(cv2.dilate(bright.astype(np.uint8), element), bool)
