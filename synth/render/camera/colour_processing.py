"""Colour processing of cameras: a matrix in linear light, then a tone curve per channel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Row = tuple[float, float, float]
Matrix = tuple[Row, Row, Row]
Curve = tuple[float, float, float, float, float]
Curves = tuple[Curve, Curve, Curve]

KNOTS = (0.05, 0.2, 0.5, 1.0, 2.0)
"""Light levels, in full scales, at which tone curves are given."""
_TO_XYZ = [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
_SHARE = 0.3  # of a published matrix's effect: rendered colours are sRGB, not a chip's


class ColourProcessing(NamedTuple):
    """Matrix and tone curves of one camera."""

    matrix: Matrix
    curves: Curves


def encode_srgb(linear: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """The sRGB transfer (IEC 61966-2-1) of linear light."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _matrix_from_xyz(*from_xyz: int) -> Matrix:
    """`_SHARE` of a chip's matrix to sRGB, from its matrix from XYZ (times 10,000, in daylight)."""
    from_srgb = np.reshape(from_xyz, (3, 3)) @ np.array(_TO_XYZ)
    chip_matrix = np.linalg.inv(from_srgb / from_srgb.sum(axis=1, keepdims=True))
    red, green, blue = (np.eye(3) + _SHARE * (chip_matrix - np.eye(3))).round(4).tolist()
    return tuple(red), tuple(green), tuple(blue)


# S-curves over sRGB that preserve highlights: weak, middle and strong.
_SOFT, _MIDDLE, _HARD = (
    (0.22, 0.48, 0.76, 0.975, 1.0),
    (0.21, 0.48, 0.77, 0.98, 1.0),
    (0.2, 0.48, 0.79, 0.98, 1.0),
)
_FULL = (0.22, 0.52, 0.84, 0.99, 1.0)  # of a channel exposed up to its shoulder, as red is on tissue
PLAIN = ColourProcessing(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (_MIDDLE,) * 3)
"""A camera of three chips, whose colours need no matrix."""
CAMERAS = (
    PLAIN,
    # By `synth fit` on three of five sectors of one intra-operative photograph.
    ColourProcessing(
        ((1.13, 0.0, -0.13), (0.0, 0.96, 0.04), (-0.02, 0.01, 1.01)),
        ((0.2, 0.43, 0.71, 0.99, 1.0), (0.21, 0.38, 0.76, 0.99, 1.0), (0.19, 0.46, 0.82, 0.96, 1.0)),
    ),
    # One chip: matrices of dcraw's `adobe_coeff` for Canon EOS 5D Mark III, Nikon D800, Sony ILCE-7.
    ColourProcessing(_matrix_from_xyz(6722, -635, -963, -4287, 12460, 2028, -908, 2162, 5668), (_SOFT,) * 3),
    ColourProcessing(
        _matrix_from_xyz(7866, -2108, -555, -4869, 12483, 2681, -1176, 2069, 7501), (_FULL, _MIDDLE, _MIDDLE)
    ),
    ColourProcessing(_matrix_from_xyz(5271, -712, -347, -6153, 13653, 2763, -1601, 2366, 7242), (_HARD,) * 3),
)
"""Cameras that a job without `sensor.matrix` and `sensor.curves` draws from."""
