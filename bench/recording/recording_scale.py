"""Millimetres per pixel and their uncertainty.

At equal flow in pixels both the depth u and the width a of a dent are proportional to the scale. On an
elastic body F = E a² g(u/a), so force is proportional to the scale's square: 5% of scale is 10% of force.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from bench.recording.meta import Meta, ScaleCalibration
from synth.errors import UserError
from synth.video import read_video as video
from synth.video.pixel_scale import ASSUMED_WIDTH_MM, pixel_mm
from synth.video.read_video import Picture

_UNKNOWN = 0.99  # relative uncertainty of an unknown scale
_STATED = 0.02  # relative uncertainty of a stated scale, unless given
_MEASURED = 0.05  # of one that two cameras measure, unless given
_POINT_PX = 1.0  # standard error of a point marked by hand
_DISTANCE = 0.01  # relative standard error of a stated working distance


@dataclass(frozen=True)
class PixelScale:
    """Scale at the tissue."""

    mm_per_px: float
    uncertainty: float  # relative, one standard deviation
    source: str


def find_scale(
    meta: Meta, folder: Path, pictures: Callable[[], Iterator[Picture]], measure: Callable[[], float]
) -> PixelScale:
    """The scale that `meta.yaml` states, calibrates by a file of the folder, or leaves to two cameras;
    `Recording.scale` is this.

    `pictures`: of the video, whose width is assumed in mm if the scale is unknown; `measure`: the scale by
    two cameras. UserError: no checkerboard found, points that coincide, no picture, or a pair that does not
    match.
    """
    if meta.scale_mm_per_px == "unknown":
        width = next(pictures()).rgb.shape[1]
        source = f"unknown: the picture is assumed to be {ASSUMED_WIDTH_MM:g} mm wide"
        scale = PixelScale(pixel_mm("unknown", width), _UNKNOWN, source)
    elif meta.scale_mm_per_px is not None:
        scale = PixelScale(meta.scale_mm_per_px, _STATED, "stated")
    elif meta.calibration is not None:
        scale = _calibrate(meta.calibration, folder)
    else:
        scale = PixelScale(measure(), _MEASURED, "two cameras")
    return scale if meta.scale_uncertainty is None else replace(scale, uncertainty=meta.scale_uncertainty)


def _calibrate(calibration: ScaleCalibration, folder: Path) -> PixelScale:
    if calibration.focal_px is not None and calibration.distance_mm is not None:
        return PixelScale(
            calibration.distance_mm / calibration.focal_px, _DISTANCE, "focal length and working distance"
        )
    if calibration.bar_px is not None and calibration.bar_mm is not None:
        return _bar(calibration.bar_px, calibration.bar_mm)
    assert calibration.checkerboard is not None
    assert calibration.corners is not None
    assert calibration.square_mm is not None
    return _checkerboard(folder / calibration.checkerboard, calibration.corners, calibration.square_mm)


def _bar(ends: tuple[tuple[float, float], tuple[float, float]], length_mm: float) -> PixelScale:
    length = float(np.hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1]))
    if length < 2:
        raise UserError(f"calibration: the ends of the bar are {length:.1f} px apart")
    return PixelScale(length_mm / length, float(np.sqrt(2)) * _POINT_PX / length, "scale bar")


def _checkerboard(path: Path, corners: tuple[int, int], square_mm: float) -> PixelScale:
    """Scale by the mean length of the squares' sides; their spread, by tilt and distortion, is its error."""
    columns, rows = corners
    grey = np.ascontiguousarray(video.read_picture(path).mean(axis=2).astype(np.uint8))
    is_found, points = cv2.findChessboardCornersSB(grey, (columns, rows))
    if not is_found:
        raise UserError(f"{path}: no checkerboard of {columns} x {rows} inner corners found")
    grid = np.asarray(points, np.float64).reshape(rows, columns, 2)
    sides = [np.linalg.norm(np.diff(grid, axis=k), axis=-1).ravel() for k in (0, 1)]
    mean_px = float((lengths := np.concatenate(sides)).mean())
    # Under tilt sides along rows and columns differ: half that difference is a systematic error.
    tilt = abs(float(sides[0].mean() - sides[1].mean())) / 2
    error = float(np.hypot(lengths.std() / np.sqrt(len(lengths)), tilt)) / mean_px
    return PixelScale(square_mm / mean_px, max(error, 1e-4), "checkerboard")
