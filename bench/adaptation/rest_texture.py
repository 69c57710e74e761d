"""The tissue of a rest frame as a texture: light taken off, hidden parts and what lies beyond filled in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from synth.fit.statistics import decode, smooth

Picture = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Map = NDArray[np.float32]

_LIGHT_MM = 6.0  # a lamp's fall-off is wider, vessels and gyri are narrower
_DARKEST = 0.02


def unroll(rgb: Picture, usable: Flags, mm_per_px: float, extent_mm: float, colour: Map) -> Picture:
    """A square texture `extent_mm` wide, the usable tissue in its middle as the camera saw it.

    Light is what varies slowly: linear colour over its mean within `_LIGHT_MM`, and the lamp's colour with
    it, as in homomorphic filtering (Oppenheim, Schafer and Stockham, Proc. IEEE 1968). Elsewhere stands the
    mirror image of the tissue at the nearest edge.

    Args:
        rgb: (H, W, 3) sRGB.
        usable: (H, W) where it shows tissue, and neither tool nor highlight.
        mm_per_px: its scale.
        extent_mm: width of the texture.
        colour: (3,) linear reflectance that tissue is to have in the mean.

    Returns:
        (N, N, 3) sRGB, as many pixels a millimetre as the picture.
    """
    linear = decode(rgb)
    light = smooth(linear, usable, _LIGHT_MM / mm_per_px)
    albedo = np.clip(linear / np.maximum(light, _DARKEST) * colour, 0, 1).astype(np.float32)
    row, column = (round(float(at.mean())) for at in np.nonzero(usable))
    side = int(np.ceil(extent_mm / mm_per_px))
    rows, columns = (np.arange(side) - side // 2 + middle for middle in (row, column))
    return _encoded(_mirrored(albedo, usable, rows, columns))


def _mirrored(picture: Map, usable: Flags, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Map:
    """(N, M, 3) of the picture at these rows and columns; where it isn't usable, mirrored at its edge."""
    height, width = usable.shape
    row, column = np.meshgrid(rows, columns, indexing="ij")
    inside = np.zeros(row.shape, bool)
    within = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    inside[within] = usable[row[within], column[within]]
    near = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    first = np.stack([row[tuple(near)], column[tuple(near)]])
    there = 2 * first - np.stack([row, column])
    there = np.clip(there, 0, np.array([height - 1, width - 1])[:, None, None])
    good = usable[tuple(there)]
    at = np.where(good, there, first)
    return np.asarray(picture[tuple(at)], np.float32)


def _encoded(linear: Map) -> Picture:
    """Linear light to sRGB."""
    share = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * np.clip(share, 0, 1)), np.uint8)
