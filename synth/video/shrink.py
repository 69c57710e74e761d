"""Downsampling of pictures and masks by a whole factor."""

from __future__ import annotations

from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.arrays import Mask

A = TypeVar("A", bound=np.generic)


def shrink_picture(picture: NDArray[A], shrink: int) -> NDArray[A]:
    """Downsamples an array (H, W[, C]) by `shrink`; a remainder at the right and bottom is cropped."""
    if shrink == 1:
        return picture
    size = (max(1, picture.shape[1] // shrink), max(1, picture.shape[0] // shrink))
    # Cropped to a multiple, so that a pixel of the small picture is shrink x shrink pixels of the large one.
    cut = picture[: size[1] * shrink, : size[0] * shrink]
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), picture.dtype)


def shrink_mask(mask: Mask, shrink: int, above: int) -> Mask:
    """Downsamples a mask (H, W); True where more than `above` / 255 of a pixel is True."""
    return np.asarray(shrink_picture(mask.astype(np.uint8) * 255, shrink) > above)
