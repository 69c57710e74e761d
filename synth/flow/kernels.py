"""Warping, derivatives and means of pictures; all arrays are float32."""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Ints, Map
from synth.system.jit import argument_types, vectorised

_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_SLOPE = np.array([1, -8, 0, 8, -1], np.float32) / np.float32(12)
_SAME = np.ones(1, np.float32)
_BORDER = 4  # px around a picture that is sampled, so that no sample needs a test
_VISIBLE = np.float32(0.9)  # least interpolated weight of the pixels read, relative to the largest
_CUBIC = np.float32(-0.75)  # free parameter of bicubic interpolation, as in PyTorch and OpenCV


def warp_into(now: Map, usable: Map, flow: Map, warped: Map, visible: Map) -> None:
    """See `image.warp`: now, usable (H, W), flow (2, H, W) px; writes warped and visible (H, W)."""
    picture = cv2.copyMakeBorder(now, *(_BORDER,) * 4, cv2.BORDER_REPLICATE)
    known = cv2.copyMakeBorder(usable, *(_BORDER,) * 4, cv2.BORDER_CONSTANT)
    width = now.shape[1]
    weights, fraction = np.empty((2, 4, width), np.float32), np.empty((2, width), np.float32)
    _sample(picture, known, flow, weights, fraction, np.empty((2, width), np.uint32), warped, visible)


@argument_types("f4[:,::1], f4[:,::1], f4[:,:,::1], f4[:,:,::1], f4[:,::1], u4[:,::1], f4[:,::1], f4[:,::1]")
@vectorised
def _sample(
    picture: Map, known: Map, flow: Map, weights: Map, fraction: Map, index: Ints, warped: Map, visible: Map
) -> None:
    """Samples padded pictures; `weights` (2, 4, W), `fraction` and `index` (2, W) are space for a row."""
    height, width = warped.shape
    a, border = _CUBIC, _BORDER
    last = (width + 1, height + 1)
    for y in range(height):
        # Weights are computed in a loop of their own, because it vectorises and the sampling does not.
        for c in range(2):
            for x in range(width):
                # Positions are clamped to the border; the integer part is clamped again because NaN passes.
                position = min(max(np.float32(y if c else x) + flow[c, y, x], -_TWO), np.float32(last[c]))
                t = position - np.floor(position)
                r = _ONE - t
                weights[c, 0, x], weights[c, 3, x] = a * t * r * r, a * r * t * t
                weights[c, 1, x] = ((a + _TWO) * t - (a + np.float32(3))) * t * t + _ONE
                weights[c, 2, x] = ((a + _TWO) * r - (a + np.float32(3))) * r * r + _ONE
                fraction[c, x], index[c, x] = t, border + min(max(np.int32(np.floor(position)), -2), last[c])
        for x in range(width):
            i, j = index[0, x], index[1, x]
            total, fx, fy = _ZERO, fraction[0, x], fraction[1, x]
            for k in range(4):
                row = j + k - 1
                line = weights[0, 0, x] * picture[row, i - 1] + weights[0, 1, x] * picture[row, i]
                line += weights[0, 2, x] * picture[row, i + 1] + weights[0, 3, x] * picture[row, i + 2]
                total += weights[1, k, x] * line
            warped[y, x] = total
            first, second = known[j, i] + fx * (known[j, i + 1] - known[j, i]), known[j + 1, i]
            interpolated = first + fy * (second + fx * (known[j + 1, i + 1] - second) - first)
            largest = max(max(known[j, i], known[j, i + 1]), max(known[j + 1, i], known[j + 1, i + 1]))
            visible[y, x] = largest if interpolated > _VISIBLE * largest else _ZERO


def differentiate(field: Map, dx: Map, dy: Map) -> None:
    """Fourth-order central differences of field (H, W) by x and y into dx and dy (H, W)."""
    cv2.sepFilter2D(field, cv2.CV_32F, _SLOPE, _SAME, dst=dx, borderType=cv2.BORDER_REPLICATE)
    cv2.sepFilter2D(field, cv2.CV_32F, _SAME, _SLOPE, dst=dy, borderType=cv2.BORDER_REPLICATE)


def box_into(field: Map, side: int, out: Map) -> None:
    """See `image.box`: means of field (N, H, W) over squares of `side` pixels, into `out`."""
    window = np.full(side, 1 / side, np.float32)
    for plane, mean in zip(field, out, strict=True):
        cv2.sepFilter2D(plane, cv2.CV_32F, window, window, dst=mean, borderType=cv2.BORDER_CONSTANT)
    radius = side // 2
    for planes in (out.swapaxes(1, 2), out):  # along columns, then along rows
        size = planes.shape[2]
        for x in (*range(min(radius, size)), *range(max(size - radius, radius), size)):
            inside = min(x, radius) + 1 + min(size - 1 - x, radius)
            planes[:, :, x] *= np.float32(side / inside)


def halve_into(field: Map, out: Map) -> None:
    """See `image.halve`: means of field (N, H, W) over 2 x 2 pixels, fewer at an odd border, into `out`."""
    height, width = out.shape[1:]
    margins = 2 * height - field.shape[1], 2 * width - field.shape[2]
    for plane, half in zip(field, out, strict=True):
        extended = (
            cv2.copyMakeBorder(plane, 0, margins[0], 0, margins[1], cv2.BORDER_REPLICATE)
            if any(margins)
            else plane
        )
        cv2.resize(extended, (width, height), dst=half, interpolation=cv2.INTER_AREA)
