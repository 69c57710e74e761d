"""What one photograph tells of its camera: vignette, noise, sharpness, and the colour of the tissue.

All are of usable pixels only, at a known scale (mm a pixel), so that a photograph and a rendered frame of
another cortex can be compared.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from synth.flow import mask_detection

Picture = npt.NDArray[np.uint8]
Map = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

_SURROUND_MM = 2.0  # a vessel is darker than what lies so far around it
_DARK = 0.3  # log green below its surround: a vessel
_GROWN_MM = 0.12  # of its edge is left out too
_TISSUE_MM = 0.5  # the colour of tissue is taken over so much of it
_BANDS_PX = ((0.7, 1.4), (2.8, 5.6))
_BLOCK = 16  # px; noise is measured where such blocks are smoothest
_SMOOTHEST = 0.2
_LEAST = 400  # px of anything that a figure is taken from


def measure(rgb: Picture, usable: Mask, mm_per_px: float, reach: float = 1.0) -> dict[str, float]:
    """Figures of one picture; those that it says nothing of are NaN.

    `vignette`: share of light lost in the corners. `noise`: standard deviation in grey levels. `sharpness`:
    contrast of the finest octave against two octaves on, both without the noise. `green`, `blue`: of tissue
    between vessels against its red, in linear light.

    Args:
        rgb: (H, W, 3) sRGB.
        usable: (H, W) tissue, without instruments.
        mm_per_px: scale.
        reach: share of the whole photograph's width that this picture, of its middle, is.
    """
    linear = decode(rgb)
    tissue = _between_vessels(linear, usable & ~mask_detection.glare(rgb, 2), mm_per_px)
    red = _smooth(linear, tissue, _TISSUE_MM / mm_per_px)[..., 0]
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    noise = _noise(grey, tissue)
    colour = linear[tissue].mean(axis=0) if tissue.sum() > _LEAST else np.full(3, np.nan)
    return {
        "vignette": _vignette(red, tissue, reach),
        "noise": noise,
        "sharpness": _sharpness(grey, usable & ~mask_detection.glare(rgb, 4), noise),
        "green": float(colour[1] / colour[0]),
        "blue": float(colour[2] / colour[0]),
    }


def decode(rgb: Picture) -> Map:
    """Linear light (H, W, 3), 0 to 1, of sRGB (IEC 61966-2-1)."""
    encoded = np.arange(256) / 255
    table = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return np.asarray(table.astype(np.float32)[rgb])


def _between_vessels(linear: Map, clear: Mask, mm_per_px: float) -> Mask:
    surround = _smooth(linear, clear, _SURROUND_MM / mm_per_px)[..., 1]
    fine = cv2.GaussianBlur(linear[..., 1], (0, 0), 0.8)
    vessel = clear & (np.log(np.maximum(surround, 1e-3) / np.maximum(fine, 1e-3)) > _DARK)
    side = 2 * max(1, round(_GROWN_MM / mm_per_px)) + 1
    return np.asarray(clear & ~(cv2.dilate(vessel.astype(np.uint8), np.ones((side, side))) > 0))


def _smooth(linear: Map, where: Mask, sigma: float) -> Map:
    """Mean of the neighbourhood's pixels that are in a mask."""
    weight = cv2.GaussianBlur(where.astype(np.float32), (0, 0), sigma)
    total = cv2.GaussianBlur(linear * where[..., None], (0, 0), sigma)
    return np.asarray(total / np.maximum(weight, 1e-3)[..., None])


def _vignette(red: Map, tissue: Mask, reach: float) -> float:
    """Share of light lost in the corners: leaves red, which blood hardly darkens, flattest on a log scale.

    Lamps light one side more than the other: a slope over the picture is no vignette.
    """
    step = max(4, min(tissue.shape) // 30)
    rows, columns = step * np.array(np.nonzero(tissue[::step, ::step]))
    if len(rows) < 40:
        return np.nan
    middle = (np.array(tissue.shape) - 1) / 2
    away = reach**2 * ((rows - middle[0]) ** 2 + (columns - middle[1]) ** 2) / (middle**2).sum()
    light = np.log(np.maximum(red[rows, columns], 1e-4)).astype(np.float64)
    basis, _ = np.linalg.qr(np.stack([np.ones(len(rows)), rows / len(rows), columns / len(rows)], axis=1))
    tried = np.linspace(-0.3, 0.95, 126)
    left = []
    for share in tried:
        flat = light - np.log(1 - share * away)
        left.append(np.abs(flat - basis @ (basis.T @ flat)).mean())
    return float(tried[int(np.argmin(left))])


def _sharpness(grey: Map, clear: Mask, noise: float) -> float:
    """Ratio of deviations in the finest octave and two octaves on."""
    if clear.sum() < _LEAST or not np.isfinite(noise):
        return np.nan
    energy = []
    for fine, coarse in _BANDS_PX:
        band = cv2.GaussianBlur(grey, (0, 0), fine) - cv2.GaussianBlur(grey, (0, 0), coarse)
        # White noise of unit variance leaves this much in a difference of Gaussians.
        left = (1 / fine**2 + 1 / coarse**2 - 4 / (fine**2 + coarse**2)) / (4 * np.pi)
        energy.append(max(float(band[clear].var()) - left * noise**2, 0.01))
    return float(np.sqrt(energy[0] / energy[1]))


def _noise(grey: Map, tissue: Mask) -> float:
    """Standard deviation of the noise in the smoothest blocks of tissue (Immerkaer's operator, 1996)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    residual = np.abs(cv2.filter2D(grey, -1, kernel))
    small = (grey.shape[1] // _BLOCK, grey.shape[0] // _BLOCK)
    rows, columns = small[1] * _BLOCK, small[0] * _BLOCK
    block = cv2.resize(residual[:rows, :columns], small, interpolation=cv2.INTER_AREA)
    full = cv2.resize(tissue[:rows, :columns].astype(np.float32), small, interpolation=cv2.INTER_AREA) > 0.95
    if full.sum() < 5:
        return np.nan
    return float(np.sqrt(np.pi / 2) / 6 * np.quantile(block[full], _SMOOTHEST))
