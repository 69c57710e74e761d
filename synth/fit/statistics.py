"""Statistics of a photograph that depend on its camera: vignette, noise and sharpness."""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Map, Mask, Pixels
from synth.flow import mask_detection

_BANDS_PX = ((0.7, 1.4), (2.8, 5.6))
_BLOCK, _SMOOTHEST = 16, 0.2  # px; noise is measured where such blocks are smoothest
_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


def measure(rgb: Pixels, usable: Mask, reach: float = 1.0) -> dict[str, float]:
    """Statistics by which a photograph can be compared with a rendered frame of another cortex.

    `vignette`: loss of light in the corners, a logarithm. `noise`: standard deviation in grey levels where
    tissue is smoothest (J. Immerkaer, 1996). `sharpness`: contrast of the finest octave relative to two
    octaves coarser, both without the noise.

    Args:
        rgb: (H, W, 3) sRGB.
        usable: (H, W) tissue, without instruments.
        reach: width of this picture, the centre of a photograph, relative to that of the photograph.
    """
    tissue, clear = (usable & ~mask_detection.glare(rgb, grown) for grown in (2, 4))
    levels = np.arange(256, dtype=np.float32) / 255
    decoded = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    block = cv2.blur(np.abs(cv2.filter2D(grey, -1, _LAPLACIAN)), (_BLOCK, _BLOCK))
    full = cv2.erode(tissue.astype(np.uint8), np.ones((_BLOCK, _BLOCK))) > 0
    noise = np.sqrt(np.pi / 2) / 6 * np.quantile(block[full if full.any() else tissue], _SMOOTHEST)
    energy = []
    for fine, coarse in _BANDS_PX:
        band = cv2.GaussianBlur(grey, (0, 0), fine) - cv2.GaussianBlur(grey, (0, 0), coarse)
        # White noise of unit variance leaves this much in a difference of Gaussians.
        left = (1 / fine**2 + 1 / coarse**2 - 4 / (fine**2 + coarse**2)) / (4 * np.pi)
        energy.append(max(float(band[clear].var()) - left * noise**2, 0.01))
    red = decoded[rgb[..., 0]] / np.median(decoded[rgb[tissue, 0]])
    found = {
        "noise": noise,
        "sharpness": np.sqrt(energy[0] / energy[1]),
        "vignette": _vignette(red, tissue, reach),
    }
    return {name: float(value) for name, value in found.items()}


def _vignette(red: Map, tissue: Mask, reach: float) -> float:
    """Loss of red light, which blood hardly absorbs, in the corners, on a log scale.

    A linear slope over the picture, from lamps at one side, is not part of the vignette.
    """
    at, middle = np.argwhere(tissue), (np.array(tissue.shape) - 1) / 2
    away = reach**2 * ((at - middle) ** 2).sum(axis=1) / (middle**2).sum()
    light = np.log(np.maximum(red[tissue], 0.5))
    slopes, *_ = np.linalg.lstsq(np.column_stack([away, np.ones(len(at)), at / len(at)]), light)
    return -float(slopes[0])
