"""Reader of stereo calibrations from OpenCV's `stereoCalibrate`: YAML, XML or JSON."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from synth.arrays import Floats
from synth.errors import UserError
from synth.flow.stereo.rig import Intrinsics, StereoRig
from synth.system import checked_file

_LEFT = ("K1", "M1", "cameraMatrix1", "camera_matrix_1", "CM1"), ("D1", "distCoeffs1", "dist_coeffs_1")
_RIGHT = ("K2", "M2", "cameraMatrix2", "camera_matrix_2", "CM2"), ("D2", "distCoeffs2", "dist_coeffs_2")
_TERMS = (4, 5, 8, 12, 14)
_ORTHOGONAL = 1e-3


def read_rig(path: Path, size: tuple[int, int], mm_per_unit: float = 1.0) -> StereoRig:
    """A pair of cameras from K1, D1, K2, D2, R and T, or the names of these in OpenCV's samples.

    `size`: width, height of the pictures used for calibration [px]; `mm_per_unit`: unit of T, given by the
    squares of the chessboard. Raises UserError if the file cannot be read or does not contain two valid
    cameras.
    """
    held = checked_file.read_storage(path)

    def matrix(names: Sequence[str], what: str) -> Floats:
        first = next((held[name] for name in names if isinstance(held.get(name), np.ndarray)), None)
        if first is None or not np.isfinite(first).all():
            raise UserError(f"{path}: the {what} is missing ({', '.join(names)})")
        return np.asarray(first, np.float64)

    cameras = []
    for (matrices, lenses), side in ((_LEFT, "left"), (_RIGHT, "right")):
        K = matrix(matrices, f"{side} camera matrix")
        if K.shape != (3, 3) or min(K[0, 0], K[1, 1]) <= 0:
            raise UserError(f"{path}: the {side} camera matrix is not 3 x 3 with positive focal lengths")
        lens = matrix(lenses, f"{side} distortion").ravel()
        if lens.size not in _TERMS:
            raise UserError(f"{path}: the {side} distortion has {lens.size} terms, OpenCV has {_TERMS}")
        cameras.append(Intrinsics(K, lens))
    rotation, translation = matrix(("R",), "rotation"), matrix(("T",), "translation").ravel()
    if rotation.size == 3:
        rotation = np.asarray(cv2.Rodrigues(rotation)[0], np.float64)
    straight = rotation.shape == (3, 3) and np.abs(rotation @ rotation.T - np.eye(3)).max() < _ORTHOGONAL
    if not straight or np.linalg.det(rotation) < 0 or translation.shape != (3,) or not translation.any():
        raise UserError(f"{path}: R is not a rotation, or T is not a translation")
    return StereoRig(cameras[0], cameras[1], rotation, mm_per_unit * translation, size)
