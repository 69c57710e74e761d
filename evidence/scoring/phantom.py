"""Pictures with a known answer: a texture of tissue's colours that a bump moves to and fro."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Rgb = NDArray[np.uint8]


def texture(height: int, width: int, rng: np.random.Generator) -> Rgb:
    """Band-passed noise in tissue's colours, (H, W, 3) uint8."""
    noise = rng.normal(size=(height, width)).astype(np.float32)
    fine = cv2.GaussianBlur(noise, (0, 0), 1.5) - cv2.GaussianBlur(noise, (0, 0), 6)
    grey = 110 + 45 * fine / fine.std()
    rgb = np.stack([grey * 1.1, grey * 0.7, grey * 0.6], axis=-1)
    return np.asarray(np.clip(rgb, 0, 210), np.uint8)


def pushed(rest: Rgb, peak_px: float) -> Rgb:
    """The texture (H, W, 3) moved right by a bump of `peak_px` in the middle."""
    height, width = rest.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    bump = np.exp(-((x - width / 2) ** 2 + (y - height / 2) ** 2) / (2 * (0.18 * height) ** 2))
    source = (x - peak_px * bump).astype(np.float32)
    return np.asarray(cv2.remap(rest, source, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), np.uint8)
