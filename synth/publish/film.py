"""What is drawn over the frames of a film: a glow where force acts, its curve below, a line of text."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.publish.picture import Rgb, heat, overlay

_CURVE_PX = 64
_WIDE_PX = 480
_LEFT_PX = 4
_TURNS = 5
_INK, _LINE = (40, 40, 40), (200, 60, 20)


def carried(values: NDArray[np.floating], flow: NDArray[np.floating]) -> NDArray[np.float32]:
    """Values on the rest frame's pixels, drawn where their points are now.

    The way back is found by iteration, which is enough for motion that is smooth over its own length.

    Args:
        values: (H, W).
        flow: (H, W, 2) px from the rest frame.
    """
    height, width = values.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    flow = flow.astype(np.float32)
    back = flow
    for _ in range(_TURNS):
        back = cv2.remap(flow, columns - back[..., 0], rows - back[..., 1], cv2.INTER_LINEAR)
    x, y = columns - back[..., 0], rows - back[..., 1]
    return np.asarray(cv2.remap(values.astype(np.float32), x, y, cv2.INTER_LINEAR), np.float32)


def glow(picture: Rgb, values: NDArray[np.floating], largest: float) -> Rgb:
    """The picture with values over it, from clear (0) to yellow (`largest`). values: (H, W), not negative."""
    share = np.clip(values / max(largest, 1e-12), 0, 1)
    return overlay(picture, heat(values, largest), np.where(share > 0.02, 0.2 + 0.6 * share, 0.0))


def draw_curve(time_s: NDArray[np.floating], values: NDArray[np.floating], width_px: int, unit: str) -> Rgb:
    """A strip (h, width_px, 3) with values over time, gaps where they are NaN. Both (T,)."""
    strip = np.full((_CURVE_PX, width_px, 3), 255, np.uint8)
    sure = np.isfinite(values)
    top = max(float(values[sure].max()), 1e-9) if sure.any() else 1.0
    level = np.clip(np.nan_to_num(values) / top, 0, 1)
    y = np.round((_CURVE_PX - 6) - level * (_CURVE_PX - 24)).astype(int)
    places = [(int(column), int(row)) for column, row in zip(_columns(len(values), width_px), y, strict=True)]
    for k in np.flatnonzero(sure[1:] & sure[:-1]):
        cv2.line(strip, places[k], places[k + 1], _LINE, 1, cv2.LINE_AA)
    text = f"0 to {top:.3g} {unit}, {time_s[0]:.2f} to {time_s[-1]:.2f} s"
    cv2.putText(strip, text, (_LEFT_PX, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _INK, 1, cv2.LINE_AA)
    return strip


def mark(curve: Rgb, k: int, count: int) -> Rgb:
    """The strip (h, w, 3) with a line at the k-th of `count` values."""
    marked = curve.copy()
    marked[16:, _columns(count, curve.shape[1])[k]] = _INK
    return marked


def legible(picture: Rgb) -> Rgb:
    """The picture (H, W, 3), each pixel repeated so that a line of text has room on it."""
    times = -(-_WIDE_PX // picture.shape[1])
    return picture.repeat(times, axis=0).repeat(times, axis=1)


def caption(picture: Rgb, text: str) -> Rgb:
    """The picture (H, W, 3) with a line of text at its top, readable on any ground."""
    canvas = np.ascontiguousarray(picture)
    for colour, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(canvas, text, (_LEFT_PX, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, thick, cv2.LINE_AA)
    return canvas


def _columns(count: int, width_px: int) -> NDArray[np.int64]:
    return np.round(np.linspace(_LEFT_PX, width_px - 1 - _LEFT_PX, count)).astype(int)
