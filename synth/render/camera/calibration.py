"""Reader of OpenCV camera calibrations: FileStorage YAML or XML, or JSON of either kind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError
from synth.job import identity
from synth.system import checked_file

_MATRIX = (
    *("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "intrinsic_matrix", "mtx"),
    *("K1", "M1", "cameraMatrix1", "camera_matrix_1", "CM1"),  # the left one of a pair
)
_LENS = (
    "distortion_coefficients",
    "distCoeffs",
    "Distortion_Coefficients",
    "dist_coeffs",
    "distortion",
    "D",
    "D1",
    "distCoeffs1",
    "dist_coeffs_1",
    "dist",
)
_TERMS = (4, 5, 8, 12, 14)  # numbers of coefficients in OpenCV
_LARGEST = 1e6  # of any value in px, and of a distortion coefficient
_SIZE = (("image_width", "image_height"), ("image_Width", "image_Height"), ("width", "height"))


def read(path: Path, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Intrinsics of a calibrated camera from a file, for pictures of a size with the same field of view.

    Args:
        path: the file.
        size: width, height [px].

    Returns:
        K (3, 3) px, with the centre of the top-left pixel at (0, 0), and distortion (5,) k1, k2, p1, p2, k3,
        or (8,) with k4, k5, k6; of a stereo calibration those of the left camera.

    Raises:
        UserError: it cannot be read, is not of a pinhole camera with Brown-Conrady distortion, perhaps
            rational, or was made from pictures of another shape.
    """
    largest, is_json = identity.FILES["render", "calibration"], path.suffix.lower() == ".json"
    try:
        found = checked_file.read_json(path, largest) if is_json else checked_file.read_storage(path, largest)
    except UserError as error:
        raise UserError(f"render.calibration: {error}") from None
    if not isinstance(found, dict):
        raise _error(path, "holds no named values")
    K = _array(path, found, _MATRIX, "camera matrix")
    if K.shape != (3, 3):
        raise _error(path, f"the camera matrix is {K.shape}, not 3 x 3")
    if (
        not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and np.abs(K).max() < _LARGEST)
        or abs(K[0, 1]) > 1e-6 * K[0, 0]
    ):
        raise _error(path, "the camera matrix has skew, or values out of range")
    lens = _array(path, found, _LENS, "distortion coefficients").ravel()
    if not (np.abs(lens) < _LARGEST).all() or len(lens) not in _TERMS or lens[8:].any():
        raise _error(
            path,
            f"{len(lens)} distortion coefficients; "
            "needed are k1 k2 p1 p2 and perhaps k3 to k6 (no thin-prism or fisheye model)",
        )
    terms = 8 if lens[5:].any() else 5
    return _resized(path, K, found, size), np.append(lens, np.zeros(8))[:terms]


def _resized(path: Path, K: Floats, found: dict[str, Any], size: tuple[int, int]) -> Floats:
    """K (3, 3) for pictures of another size than those it was made from, if these are known."""
    for wide, tall in _SIZE:
        if wide in found and tall in found:
            break
    else:
        return K
    try:
        width, height = int(float(found[wide])), int(float(found[tall]))
    except (TypeError, ValueError, OverflowError):
        width, height = 0, 0
    if min(width, height) < 1:
        raise _error(path, f"{wide} and {tall} are not a picture's size")
    if (width, height) == size:
        return K
    across, down = size[0] / width, size[1] / height
    if abs(across / down - 1) > 0.01:
        raise UserError(
            f"render.calibration: made from pictures of {width} x {height}, whose shape "
            f"differs from render.size {size[0]} x {size[1]}; change render.size"
        )
    return scaled(K, np.array([across, down]))


def scaled(K: Floats, scale: Floats) -> Floats:
    """K (3, 3) of pictures that are wider and higher by factors (2,)."""
    K = K * np.append(scale, 1.0)[:, None]
    K[:2, 2] += 0.5 * scale - 0.5  # pixel centres, not corners, are whole numbers
    return K


def _array(path: Path, found: dict[str, Any], names: tuple[str, ...], what: str) -> Floats:
    for name in names:
        value = found.get(name)
        if value is None:
            continue
        try:
            if isinstance(value, dict):  # OpenCV's own JSON: {"rows": 3, "cols": 3, "data": [...]}
                value = np.reshape(value["data"], (int(value["rows"]), -1))
            return np.asarray(value, np.float64)
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError):
            raise _error(path, f"{name} is not a matrix of numbers") from None
    raise _error(path, f"holds no {what} (looked for {', '.join(names)})")


def _error(path: Path, fault: str) -> UserError:
    return UserError(f"render.calibration: {path.name}: {fault}")
