"""Pictures that show nothing to follow: an estimator answers zero motion there, which is no measurement."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_LEAST_SIDE = 24  # px of the picture; below it no window of any estimator fits
_LEAST_TISSUE = 400  # px
_DARK = 12.0  # grey levels that 95% of the tissue stay below
_FLAT = 0.5  # grey levels of detail; a camera's own noise is more


def find_fault(rgb: NDArray[np.uint8], tissue: NDArray[np.bool_]) -> str:
    """Why nothing can be followed in a picture; empty if something may be.

    Args:
        rgb: (H, W, 3) uint8.
        tissue: (H, W).
    """
    height, width = tissue.shape
    if min(height, width) < _LEAST_SIDE:
        return f"only {width} x {height} px large"
    count = int(tissue.sum())
    if count < _LEAST_TISSUE:
        return f"only {count} px of it are tissue"
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    if float(np.percentile(grey[tissue], 95)) < _DARK:
        return "black"
    detail = grey - cv2.GaussianBlur(grey, (0, 0), 3)
    if float(detail[tissue].std()) < _FLAT:
        return "of one colour, without any detail"
    return ""
