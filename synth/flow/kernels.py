"""Compiled loops over pixels for warping, derivatives and means; all arrays are float32."""

from __future__ import annotations

import numpy as np

from synth.arrays import Map
from synth.system.jit import vectorised

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_EIGHT, _TWELFTH = np.float32(8), np.float32(1 / 12)
_VISIBLE = np.float32(0.9)  # least interpolated weight of the pixels read, relative to the largest
_CUBIC = np.float32(-0.75)  # free parameter of bicubic interpolation, as in PyTorch and OpenCV


@vectorised
def warp_into(now: Map, usable: Map, flow: Map, warped: Map, visible: Map) -> None:
    """See `image.warp`: now, usable (H, W), flow (2, H, W) px; writes warped and visible (H, W)."""
    height, width = now.shape
    a, border = _CUBIC, 4
    picture, known = _padded(now, border), np.zeros((height + 2 * border, width + 2 * border), np.float32)
    known[border : height + border, border : width + border] = usable
    weights, share = np.empty((2, 4, width), np.float32), np.empty((2, width), np.float32)
    whole, last = np.empty((2, width), np.uint32), (width + 1, height + 1)
    for y in range(height):
        # Weights are computed in a loop of their own, because it vectorises and the sampling does not.
        for c in range(2):
            for x in range(width):
                # Positions are clamped to the border; the integer part is clamped again because NaN passes.
                at = min(max(np.float32(y if c else x) + flow[c, y, x], -_TWO), np.float32(last[c]))
                t = at - np.floor(at)
                r = _ONE - t
                weights[c, 0, x], weights[c, 3, x] = a * t * r * r, a * r * t * t
                weights[c, 1, x] = ((a + _TWO) * t - (a + np.float32(3))) * t * t + _ONE
                weights[c, 2, x] = ((a + _TWO) * r - (a + np.float32(3))) * r * r + _ONE
                share[c, x], whole[c, x] = t, border + min(max(np.int32(np.floor(at)), -2), last[c])
        for x in range(width):
            i, j = whole[0, x], whole[1, x]
            total, fx, fy = _ZERO, share[0, x], share[1, x]
            for k in range(4):
                row = j + k - 1
                line = weights[0, 0, x] * picture[row, i - 1] + weights[0, 1, x] * picture[row, i]
                line += weights[0, 2, x] * picture[row, i + 1] + weights[0, 3, x] * picture[row, i + 2]
                total += weights[1, k, x] * line
            warped[y, x] = total
            first, second = known[j, i] + fx * (known[j, i + 1] - known[j, i]), known[j + 1, i]
            some = first + fy * (second + fx * (known[j + 1, i + 1] - second) - first)
            most = max(max(known[j, i], known[j, i + 1]), max(known[j + 1, i], known[j + 1, i + 1]))
            visible[y, x] = most if some > _VISIBLE * most else _ZERO


@vectorised
def differentiate(field: Map, dx: Map, dy: Map) -> None:
    """Fourth-order central differences of field (H, W) by x and y into dx and dy (H, W)."""
    padded = _padded(field, 2)
    height, width = dx.shape
    for y in range(height):
        for x in range(width):
            right, left = padded[y + 2, x + 3], padded[y + 2, x + 1]
            dx[y, x] = (_EIGHT * (right - left) - (padded[y + 2, x + 4] - padded[y + 2, x])) * _TWELFTH
            below, above = padded[y + 3, x + 2], padded[y + 1, x + 2]
            dy[y, x] = (_EIGHT * (below - above) - (padded[y + 4, x + 2] - padded[y, x + 2])) * _TWELFTH


@vectorised
def _padded(field: Map, border: int) -> Map:
    """`field` (H, W) padded by `border` repeated pixels on every side."""
    height, width = field.shape
    padded = np.empty((height + 2 * border, width + 2 * border), np.float32)
    for y in range(height + 2 * border):
        row = field[min(max(y - border, 0), height - 1)]
        padded[y, :border], padded[y, border : width + border] = row[0], row
        padded[y, width + border :] = row[width - 1]
    return padded


@vectorised
def box_into(field: Map, across: tuple[int, ...], out: Map) -> None:
    """See `image.box`: means of field (N, H, W) over squares of `len(across)` pixels, into `out`.

    The length of a tuple is a compile-time constant, so sums over it are unrolled: six times as fast.
    """
    count, height, width = field.shape
    radius = len(across) // 2
    column, share = np.zeros(width + 2 * radius, np.float32), np.empty(width, np.float32)
    for x in range(width):
        share[x] = _ONE / np.float32(min(x, radius) + min(width - 1 - x, radius) + 1)
    for n in range(count):
        for y in range(height):
            part = _ONE / np.float32(min(y, radius) + min(height - 1 - y, radius) + 1)
            for x in range(width):
                total = _ZERO
                for k in range(len(across)):
                    row = y + k - radius
                    total += np.float32(0 <= row < height) * field[n, min(max(row, 0), height - 1), x]
                column[radius + x] = total * part
            for x in range(width):
                total = _ZERO
                for k in range(len(across)):
                    total += column[x + k]
                out[n, y, x] = total * share[x]


@vectorised
def halve_into(field: Map, out: Map) -> None:
    """See `image.halved`: means of field (N, H, W) over 2 x 2 pixels, fewer at an odd border, into `out`."""
    count, height, width = field.shape
    for n in range(count):
        for y in range(out.shape[1]):
            top, below = 2 * y, min(2 * y + 1, height - 1)
            for x in range(width // 2):
                upper = field[n, top, 2 * x] + field[n, top, 2 * x + 1]
                lower = field[n, below, 2 * x] + field[n, below, 2 * x + 1]
                out[n, y, x] = (upper + lower) * np.float32(0.25)
            if width % 2:
                out[n, y, width // 2] = (field[n, top, width - 1] + field[n, below, width - 1]) * _HALF
