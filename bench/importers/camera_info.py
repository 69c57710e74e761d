"""ROS camera calibrations (sensor_msgs/CameraInfo) in OpenCV's convention."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError

_TERMS = {"plumb_bob": (4, 5), "rational_polynomial": (8,)}


@dataclass(frozen=True)
class Lens:
    """A camera and its pose in its stereo pair."""

    K: Floats  # (3, 3) px
    distortion: Floats  # (D,) in OpenCV's order
    turn: Floats  # (3, 3) rotation from its axes to the rectified pair's
    shift_mm: float  # x of the left lens in the rectified axes, with this lens at the origin


def read_lens(topic: str, info: Any, pictures: str, size: tuple[int, int]) -> Lens:
    """The camera of a calibration message `info` of ROS 1 or 2.

    `pictures`: the topic of the camera's pictures, of width and height `size` [px]; those named
    `image_rect...` are already rectified. Raises UserError for no calibration, or one for another size.
    """
    K, D, R, P = (np.asarray(getattr(info, n, getattr(info, n.upper(), ())), np.float64) for n in "kdrp")
    if (info.width, info.height) != size:
        calibrated = f"{info.width} x {info.height}"
        raise UserError(f"{topic}: calibrated at {calibrated} px, but {pictures} has {size[0]} x {size[1]}")
    K, P = K.reshape(3, 3), P.reshape(3, 4)
    if not (np.isfinite([*K.flat, *P.flat]).all() and min(K[0, 0], K[1, 1], P[0, 0], P[1, 1]) > 0):
        raise UserError(f"{topic}: the camera isn't calibrated (K or P is 0)")
    shift_mm = 1000 * float(P[0, 3] / P[0, 0])
    if image_name(pictures).startswith("image_rect"):
        return Lens(P[:, :3], np.zeros(5), np.eye(3), shift_mm)
    if D.any() and len(D) not in _TERMS.get(info.distortion_model, ()):
        raise UserError(
            f"{topic}: distortion {info.distortion_model} with {len(D)} terms is not one of OpenCV's models"
        )
    return Lens(K, D if D.any() else np.zeros(5), R.reshape(3, 3), shift_mm)


def image_name(topic: str) -> str:
    """The last part of a picture topic's name, without its transport."""
    return [part for part in topic.split("/") if not part.startswith("compressed")][-1]


def info_name(topic: str) -> str:
    """The topic on which ROS publishes the calibration of a picture topic."""
    return topic[: topic.rindex(image_name(topic))] + "camera_info"


def join_pair(left: Lens, right: Lens) -> dict[str, Floats]:
    """K1, D1, K2, D2, R, T [mm] as in OpenCV's `stereoCalibrate`: x_right = R x_left + T.

    Raises UserError if the baseline is 0.
    """
    baseline = right.shift_mm - left.shift_mm
    if not baseline:
        raise UserError("the calibrations have no baseline (P[0, 3] of the right camera's camera_info)")
    rotation, translation = right.turn.T @ left.turn, right.turn.T @ [[baseline], [0.0], [0.0]]
    lenses = {"K1": left.K, "D1": left.distortion, "K2": right.K, "D2": right.distortion}
    return {**lenses, "R": rotation, "T": translation}
