"""Calibrations of the camera that is rendered."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError
from synth.job import identity
from synth.system import camera_file

_RATIONAL = 8  # distortion coefficients that are rendered, k1 k2 p1 p2 k3 to k6


def read(path: Path, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Intrinsics of a calibrated camera from a file, for pictures of a size with the same field of view.

    Args:
        path: the file; of a stereo pair, the left camera is read.
        size: width, height [px].

    Returns:
        K (3, 3) px, with the centre of the top-left pixel at (0, 0), and distortion (5,) k1, k2, p1, p2, k3,
        or (8,) with k4, k5, k6.

    Raises:
        UserError: it cannot be read, is not of a pinhole camera with Brown-Conrady distortion, perhaps
            rational, or was made from pictures of another shape.
    """
    try:
        K, lens = camera_file.read_lens(path, size, identity.FILES["render", "calibration"])
    except UserError as error:
        raise UserError(f"render.calibration: {error}") from None
    if lens[_RATIONAL:].any():
        raise UserError(f"render.calibration: {path}: has thin-prism distortion, which is not rendered")
    return K, np.append(lens, np.zeros(_RATIONAL))[: _RATIONAL if lens[5:].any() else 5]


def scaled(K: Floats, scale: Floats) -> Floats:
    """K (3, 3) of pictures that are wider and higher by factors (2,)."""
    K = K * np.append(scale, 1.0)[:, None]
    K[:2, 2] += 0.5 * scale - 0.5  # pixel centres, not corners, are whole numbers
    return K
