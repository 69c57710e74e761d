"""Calibrations of the camera that is rendered."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError, as_user_error
from synth.system import camera_file

_RATIONAL = 8  # distortion coefficients that are rendered, k1 k2 p1 p2 k3 to k6


def read(path: Path, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """As `camera_file.read_lens`, with a distortion of (5,) k1, k2, p1, p2, k3, or (8,) with k4, k5, k6.

    Raises UserError also for a lens with further coefficients.
    """
    with as_user_error("render.calibration"):
        K, distortion = camera_file.read_lens(path, size)
    return K, trim_distortion(distortion, path)


def trim_distortion(distortion: Floats, path: Path) -> Floats:
    """Distortion (5,) or (8,) of a calibration's (4 to 14,). UserError for one that can't be rendered."""
    if distortion[_RATIONAL:].any():
        raise UserError(f"render.calibration: {path}: has thin-prism distortion, which is not rendered")
    return np.append(distortion, np.zeros(_RATIONAL))[: _RATIONAL if distortion[5:].any() else 5]


def scale_intrinsics(K: Floats, scale: Floats) -> Floats:
    """K (3, 3) of pictures that are wider and higher by factors (2,)."""
    K = K * np.append(scale, 1.0)[:, None]
    K[:2, 2] += 0.5 * scale - 0.5  # pixel centres, not corners, are whole numbers
    return K
