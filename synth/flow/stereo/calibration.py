"""Calibrations of stereo pairs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from synth.errors import UserError
from synth.flow.stereo.rig import Intrinsics, StereoRig
from synth.system import camera_file

_BASELINE_MM = 0.5, 500.0  # of a chip at an endoscope's tip, of a large rig


def read_rig(path: Path, size: tuple[int, int], mm_per_unit: float = 1.0) -> StereoRig:
    """A pair of cameras from K1, D1, K2, D2, R and T of OpenCV's `stereoCalibrate`, or other programs' names.

    `size`: width, height [px] of the pictures; `mm_per_unit`: unit of T, given by the squares of the
    chessboard; 1 is metres for Kalibr. Raises UserError if the file cannot be read or does not contain two
    valid cameras, or if the distance between them is implausible.
    """
    left, right, rotation, translation, stated_unit = camera_file.read_pair(path, size)
    unit = stated_unit if stated_unit and mm_per_unit == 1 else mm_per_unit
    rig = StereoRig(Intrinsics(*left), Intrinsics(*right), rotation, unit * translation, size)
    low, high = _BASELINE_MM
    if not low <= rig.baseline_mm <= high:
        metres = "; 1000 if T is in metres" if low <= 1000 * np.linalg.norm(translation) <= high else ""
        raise UserError(
            f"{path}: the cameras are {rig.baseline_mm:.3g} mm apart; write T in mm, or set mm_per_unit, in "
            f"a recording stereo.mm_per_unit (the side of a chessboard's square{metres})"
        )
    return rig
