"""The inner loops of `tvl1` on the CPU, each a single pass over the pixels instead of one a product.

They compute what the tensor code of `tvl1.step` computes (which stays for CUDA, and as what these are tested
against), for one pair of pictures: equations and symbols are those of that file. Everything is float32.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synth.system.jit import vectorised

Map = NDArray[np.float32]

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_EIGHT, _TWELFTH = np.float32(8), np.float32(1 / 12)
_SEEN = np.float32(0.9)  # of what a sample is read from must be usable
_CUBIC = np.float32(-0.75)  # the free parameter of bicubic interpolation that PyTorch and OpenCV have
_FEW = np.float32(1e-12)


@vectorised
def warp_into(now: Map, usable: Map, flow: Map, warped: Map, seen: Map) -> None:
    """See `image.warp`: now, usable (H, W), flow (2, H, W) px; writes warped and seen (H, W)."""
    height, width = now.shape
    a = _CUBIC
    wx, wy = np.empty(4, np.float32), np.empty(4, np.float32)
    for y in range(height):
        for x in range(width):
            at_x, at_y = np.float32(x) + flow[0, y, x], np.float32(y) + flow[1, y, x]
            # A flow that ran away reads the border; no integer holds where it points to.
            at_x = min(max(at_x, np.float32(-1e6)), np.float32(1e6))
            at_y = min(max(at_y, np.float32(-1e6)), np.float32(1e6))
            left, top = np.floor(at_x), np.floor(at_y)
            fx, fy = at_x - left, at_y - top
            i, j = int(left), int(top)
            for weights, t in ((wx, fx), (wy, fy)):
                s, r = t + _ONE, _ONE - t
                weights[0] = ((a * s - np.float32(5) * a) * s + _EIGHT * a) * s - np.float32(4) * a
                weights[1] = ((a + _TWO) * t - (a + np.float32(3))) * t * t + _ONE
                weights[2] = ((a + _TWO) * r - (a + np.float32(3))) * r * r + _ONE
                s = r + _ONE
                weights[3] = ((a * s - np.float32(5) * a) * s + _EIGHT * a) * s - np.float32(4) * a
            total, known = _ZERO, _ZERO
            if 1 <= i < width - 2 and 1 <= j < height - 2:
                for k in range(4):
                    line = wx[0] * now[j + k - 1, i - 1] + wx[1] * now[j + k - 1, i]
                    line += wx[2] * now[j + k - 1, i + 1] + wx[3] * now[j + k - 1, i + 2]
                    total += wy[k] * line
                warped[y, x] = total
                known = (_ONE - fy) * ((_ONE - fx) * usable[j, i] + fx * usable[j, i + 1])
                known += fy * ((_ONE - fx) * usable[j + 1, i] + fx * usable[j + 1, i + 1])
                seen[y, x] = _ONE if known > _SEEN else _ZERO
                continue
            for k in range(4):
                row = min(max(j + k - 1, 0), height - 1)
                line = _ZERO
                for m in range(4):
                    line += wx[m] * now[row, min(max(i + m - 1, 0), width - 1)]
                total += wy[k] * line
            warped[y, x] = total
            for k in range(2):
                for m in range(2):
                    if 0 <= j + k < height and 0 <= i + m < width:
                        part = (fx if m else _ONE - fx) * (fy if k else _ONE - fy)
                        known += part * usable[j + k, i + m]
            seen[y, x] = _ONE if known > _SEEN else _ZERO


def differentiate(field: Map, dx: Map, dy: Map) -> None:
    """See `image.derivative`: derivatives of field (H, W) by x and by y, into dx and dy (H, W)."""
    _differentiate(_padded(field), dx, dy)


@vectorised
def _differentiate(padded: Map, dx: Map, dy: Map) -> None:
    height, width = dx.shape
    for y in range(height):
        for x in range(width):
            right, left = padded[y + 2, x + 3], padded[y + 2, x + 1]
            dx[y, x] = (_EIGHT * (right - left) - (padded[y + 2, x + 4] - padded[y + 2, x])) * _TWELFTH
            below, above = padded[y + 3, x + 2], padded[y + 1, x + 2]
            dy[y, x] = (_EIGHT * (below - above) - (padded[y + 4, x + 2] - padded[y, x + 2])) * _TWELFTH


@vectorised
def _padded(field: Map) -> Map:
    """`field` (H, W) with two pixels of its border repeated around it, (H + 4, W + 4)."""
    height, width = field.shape
    padded = np.empty((height + 4, width + 4), np.float32)
    for y in range(height + 4):
        row = min(max(y - 2, 0), height - 1)
        for x in range(width):
            padded[y, x + 2] = field[row, x]
        padded[y, 0] = padded[y, 1] = field[row, 0]
        padded[y, width + 2] = padded[y, width + 3] = field[row, width - 1]
    return padded


@vectorised
def compare(rest: Map, warped: Map, gamma: np.float32, residual: Map, mean: Map) -> None:
    """Residual and mean (3, H, W) of picture and gradient: rest, warped (3, H, W) hold I, d_x I, d_y I."""
    height, width = rest.shape[1:]
    for k in range(3):
        by = _ONE if k == 0 else gamma
        for y in range(height):
            for x in range(width):
                before, after = by * rest[k, y, x], by * warped[k, y, x]
                residual[k, y, x] = after - before
                mean[k, y, x] = _HALF * (after + before)


@vectorised
def linearise(
    residual: Map,
    rows: Map,
    columns: Map,
    mask: Map,
    weight: Map,
    flow: Map,
    tau: np.float32,
    epsilon: np.float32,
    prox: Map,
) -> None:
    """The data term's prox as an affine map, linearised at `flow`.

    Args:
        residual, rows, columns: (3, H, W), r and its derivatives by u and v.
        mask, weight: (H, W), m and lambda.
        flow: (2, H, W) px.
        tau, epsilon: of `TVL1Settings`.
        prox: (5, H, W), written: straight (2), cross (1), shift (2).
    """
    height, width = mask.shape
    square = epsilon * epsilon
    for y in range(height):
        for x in range(width):
            u, v = flow[0, y, x], flow[1, y, x]
            norm = square
            xx, xy, yy, gx, gy = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
            for k in range(3):
                r, a, b = residual[k, y, x], rows[k, y, x], columns[k, y, x]
                norm += r * r
                xx += a * a
                xy += a * b
                yy += b * b
                offset = r - a * u - b * v
                gx += a * offset
                gy += b * offset
            c = tau * weight[y, x] * mask[y, x] / np.sqrt(norm)
            # (1 + c J^T J) w = v - c J^T (r - J w_0), 2x2 by Cramer.
            xx, xy, yy, gx, gy = _ONE + c * xx, c * xy, _ONE + c * yy, c * gx, c * gy
            scale = _ONE / (xx * yy - xy * xy)
            prox[0, y, x], prox[1, y, x] = yy * scale, xx * scale
            prox[2, y, x] = -xy * scale
            prox[3, y, x] = (yy * gx - xy * gy) * scale
            prox[4, y, x] = (xx * gy - xy * gx) * scale


@vectorised
def primal_dual(
    flow: Map, ahead: Map, px: Map, py: Map, prox: Map, shrink: Map, tau: np.float32, steps: int
) -> None:
    """`steps` of Chambolle and Pock's algorithm 1, in place.

    A row of step k needs this row and the next of step k - 1, no more: all steps go down the picture
    together, each one row behind the one before it, so that what they share stays in the cache.

    Args:
        flow, ahead: (2, H, W) px, w and its extrapolation (of the same values at the start).
        px, py: (2, H, W), the dual of grad w.
        prox: (5, H, W), see `linearise`.
        shrink: (H, W), 1 / (1 + sigma h).
        tau: primal step; the dual step sigma is 1 / (8 tau).
        steps: how many.
    """
    height, width = shrink.shape
    sigma = _ONE / (_EIGHT * tau)
    for sweep in range(height + steps - 1):
        for k in range(max(0, sweep - height + 1), min(steps, sweep + 1)):
            y = sweep - k
            below = min(y + 1, height - 1)
            for c in range(2):
                # The last column's dual stays 0, as the last row's does: no gradient leaves the picture.
                for x in range(width - 1):
                    step_x = ahead[c, y, x + 1] - ahead[c, y, x]
                    step_y = ahead[c, below, x] - ahead[c, y, x]
                    p = (px[c, y, x] + sigma * step_x) * shrink[y, x]
                    q = (py[c, y, x] + sigma * step_y) * shrink[y, x]
                    norm = _ONE / np.sqrt(max(_ONE, p * p + q * q))
                    px[c, y, x] = p * norm
                    py[c, y, x] = q * norm
                x = width - 1
                q = (py[c, y, x] + sigma * (ahead[c, below, x] - ahead[c, y, x])) * shrink[y, x]
                py[c, y, x] = q / max(_ONE, abs(q))
            if y == 0:
                for x in range(width):
                    for c in range(2):
                        ahead[c, 0, x] = px[c, 0, x] + py[c, 0, x]
            else:
                for x in range(width):
                    for c in range(2):
                        ahead[c, y, x] = px[c, y, x] + py[c, y, x] - py[c, y - 1, x]
            # `ahead` holds div p but for the part of the column before, in this row only.
            for c in range(2):
                for x in range(width - 1, 0, -1):
                    ahead[c, y, x] -= px[c, y, x - 1]
            for x in range(width):
                u, v = flow[0, y, x], flow[1, y, x]
                a, b = u + tau * ahead[0, y, x], v + tau * ahead[1, y, x]
                new_u = prox[0, y, x] * a + prox[2, y, x] * b - prox[3, y, x]
                new_v = prox[1, y, x] * b + prox[2, y, x] * a - prox[4, y, x]
                flow[0, y, x], flow[1, y, x] = new_u, new_v
                ahead[0, y, x], ahead[1, y, x] = _TWO * new_u - u, _TWO * new_v - v


@vectorised
def box_into(field: Map, radius: int, between: Map, out: Map) -> None:
    """See `image.box`: means of field (N, H, W) over squares, into `out` by way of `between` (N, H, W)."""
    count, height, width = field.shape
    for n in range(count):
        for y in range(height):
            between[n, y] = _ZERO
            for shift in range(-radius, radius + 1):
                for x in range(max(0, -shift), min(width, width - shift)):
                    between[n, y, x] += field[n, y, x + shift]
            for x in range(width):
                between[n, y, x] /= np.float32(min(x, radius) + min(width - 1 - x, radius) + 1)
        for y in range(height):
            first, last = max(0, y - radius), min(height - 1, y + radius)
            out[n, y] = _ZERO
            for row in range(first, last + 1):
                for x in range(width):
                    out[n, y, x] += between[n, row, x]
            share = _ONE / np.float32(last - first + 1)
            for x in range(width):
                out[n, y, x] *= share


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


@vectorised
def median_into(field: Map, out: Map) -> None:
    """See `image.median3`: 3x3 median of `field` (H, W), its border repeated, into `out` (H, W)."""
    height, width = field.shape
    low, mid, high = (
        np.empty(width + 2, np.float32),
        np.empty(width + 2, np.float32),
        np.empty(width + 2, np.float32),
    )
    for y in range(height):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            a, b, c = field[above, x], field[y, x], field[below, x]
            least, most = min(a, b), max(a, b)
            middle, most = min(most, c), max(most, c)
            low[x + 1], mid[x + 1], high[x + 1] = min(least, middle), max(least, middle), most
        for column in (low, mid, high):
            column[0], column[width + 1] = column[1], column[width]
        for x in range(width):
            top = max(max(low[x], low[x + 1]), low[x + 2])
            bottom = min(min(high[x], high[x + 1]), high[x + 2])
            m0, m1, m2 = mid[x], mid[x + 1], mid[x + 2]
            middle = max(min(m0, m1), min(max(m0, m1), m2))
            out[y, x] = max(min(top, middle), min(max(top, middle), bottom))


def noise_weight(residual: Map, mask: Map, noise: float, least: float, most: float) -> float:
    """See `tvl1.noise_weight`; residual (3, H, W), mask (H, W)."""
    some = residual[:, ::2, ::2]
    square = (some * some).sum(axis=0)[mask[::2, ::2] > 0]
    if not len(square):
        return 1.0
    middle = (len(square) - 1) // 2
    found = float(np.partition(square, middle)[middle])
    return float(np.clip(noise**2 / max(found, float(_FEW)), least, most))
