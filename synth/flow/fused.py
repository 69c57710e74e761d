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
_LANES = 16  # floats of the widest vectors


@vectorised
def warp_into(now: Map, usable: Map, flow: Map, warped: Map, seen: Map) -> None:
    """See `image.warp`: now, usable (H, W), flow (2, H, W) px; writes warped and seen (H, W)."""
    height, width = now.shape
    a, border = _CUBIC, 4
    picture, known = _padded(now, border), np.zeros((height + 2 * border, width + 2 * border), np.float32)
    known[border : height + border, border : width + border] = usable
    weights, share = np.empty((2, 4, width), np.float32), np.empty((2, width), np.float32)
    whole, last = np.empty((2, width), np.uint32), (width + 1, height + 1)
    for y in range(height):
        # Weights first, for they are computed many at a time, as samples can't be.
        for c in range(2):
            for x in range(width):
                # Beyond the border all is as at it. Whole numbers are limited once more: nan passes.
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
            some = (_ONE - fy) * ((_ONE - fx) * known[j, i] + fx * known[j, i + 1])
            some += fy * ((_ONE - fx) * known[j + 1, i] + fx * known[j + 1, i + 1])
            seen[y, x] = _ONE if some > _SEEN else _ZERO


@vectorised
def differentiate(field: Map, dx: Map, dy: Map) -> None:
    """See `image.derivative`: derivatives of field (H, W) by x and by y, into dx and dy (H, W)."""
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
    """`field` (H, W) with `border` pixels of its border repeated around it."""
    height, width = field.shape
    padded = np.empty((height + 2 * border, width + 2 * border), np.float32)
    for y in range(height + 2 * border):
        row = field[min(max(y - border, 0), height - 1)]
        padded[y, :border], padded[y, border : width + border] = row[0], row
        padded[y, width + border :] = row[width - 1]
    return padded


@vectorised
def linearise(before: Map, after: Map, mask: Map, weight: Map, flow: Map, numbers: Map, state: Map) -> None:
    """The data term's prox as an affine map of (v_x, v_y), and the dual's factor 1 / (1 + sigma h).

    Args:
        before, after: (6, H, W), the rest frame and the warped one: I, d_x, d_y, d_xx, d_xy, d_yy of it.
        mask, weight: (H, W).
        flow: (2, H, W) px, what is linearised about.
        numbers: tau, gamma, epsilon, h where something is seen, and what is added to it where nothing is.
        state: see `new_state`; its last six planes are written.
    """
    height, width = mask.shape
    tau, gamma, epsilon, huber, hidden_huber = numbers
    for y in range(height):
        for x in range(width):
            u, v = flow[0, y, x], flow[1, y, x]
            # Residual r; slopes a by x and b by y of the mean of both pictures, b1 being a2.
            r0 = after[0, y, x] - before[0, y, x]
            r1 = gamma * (after[1, y, x] - before[1, y, x])
            r2 = gamma * (after[2, y, x] - before[2, y, x])
            a0 = _HALF * (after[1, y, x] + before[1, y, x])
            b0 = _HALF * (after[2, y, x] + before[2, y, x])
            a1 = _HALF * gamma * (after[3, y, x] + before[3, y, x])
            b1 = _HALF * gamma * (after[4, y, x] + before[4, y, x])
            b2 = _HALF * gamma * (after[5, y, x] + before[5, y, x])
            norm = np.sqrt(r0 * r0 + r1 * r1 + r2 * r2 + epsilon * epsilon)
            c = tau * weight[y, x] * mask[y, x] / norm
            # (1 + c J^T J) w = v - c J^T (r - J w_0), 2x2 by Cramer.
            xx, xy, yy = a0 * a0 + a1 * a1 + b1 * b1, a0 * b0 + a1 * b1 + b1 * b2, b0 * b0 + b1 * b1 + b2 * b2
            gx = c * (a0 * r0 + a1 * r1 + b1 * r2 - xx * u - xy * v)
            gy = c * (b0 * r0 + b1 * r1 + b2 * r2 - xy * u - yy * v)
            xx, xy, yy = _ONE + c * xx, c * xy, _ONE + c * yy
            scale = _ONE / (xx * yy - xy * xy)
            state[8, y, x], state[9, y, x], state[10, y, x] = yy * scale, xx * scale, -xy * scale
            state[11, y, x], state[12, y, x] = (yy * gx - xy * gy) * scale, (xx * gy - xy * gx) * scale
            state[13, y, x] = _ONE / (_ONE + (huber + hidden_huber * (_ONE - mask[y, x])) / (_EIGHT * tau))


def new_state(height: int, width: int) -> Map:
    """Planes of `primal_dual`: w (2), its extrapolation (2), the dual of grad w by x (2) and by y (2), at 0,
    the prox: straight (2), cross (1), shift (2), and 1 / (1 + sigma h).

    Wider than the picture and aligned, so that loops of whole vectors have no rest: without, they took 1.6
    times as long. The dual stands a row lower, that by x `_LANES` further right: 0 comes before it.
    """
    shape = 14, height + 1, -(-width // _LANES) * _LANES + _LANES
    flat = np.empty(int(np.prod(shape)) + _LANES, np.float32)
    state: Map = flat[-(flat.ctypes.data // 4) % _LANES :][: int(np.prod(shape))].reshape(shape)
    state[4:8] = state[..., width:] = 0
    return state


@vectorised
def primal_dual(flow: Map, state: Map, tau: np.float32, steps: int) -> None:
    """`steps` of Chambolle and Pock's algorithm 1, in place.

    A row of step k needs this row and the next of step k - 1, no more: all steps go down the picture
    together, each one row behind the one before it, so that what they share stays in the cache.

    Args:
        flow: (2, H, W) px.
        state: see `new_state`.
        tau: primal step; the dual step sigma is 1 / (8 tau).
        steps: how many.
    """
    height, width = flow.shape[1:]
    wide = state.shape[2] - _LANES
    sigma = _ONE / (_EIGHT * tau)
    sigma_x = np.full(wide, sigma)  # no gradient leaves the picture: the last column's dual stays 0
    sigma_x[width - 1 :] = _ZERO
    now, ahead, px, py, prox, shrink = state[:2], state[2:4], state[4:6], state[6:8], state[8:13], state[13]
    now[:, :height, :width] = flow
    ahead[:, :height, :width] = flow
    for sweep in range(height + steps - 1):
        for k in range(max(0, sweep - height + 1), min(steps, sweep + 1)):
            y = sweep - k
            below = min(y + 1, height - 1)
            for c in range(2):
                for x in range(wide):
                    here = ahead[c, y, x]
                    p = px[c, y + 1, x + _LANES] + sigma_x[x] * (ahead[c, y, x + 1] - here)
                    q = py[c, y + 1, x] + sigma * (ahead[c, below, x] - here)
                    p, q = p * shrink[y, x], q * shrink[y, x]
                    norm = _ONE / np.sqrt(max(_ONE, p * p + q * q))
                    px[c, y + 1, x + _LANES], py[c, y + 1, x] = p * norm, q * norm
            for x in range(wide):
                u, v = now[0, y, x], now[1, y, x]
                a = px[0, y + 1, x + _LANES] - px[0, y + 1, x + _LANES - 1] + py[0, y + 1, x] - py[0, y, x]
                b = px[1, y + 1, x + _LANES] - px[1, y + 1, x + _LANES - 1] + py[1, y + 1, x] - py[1, y, x]
                a, b = u + tau * a, v + tau * b
                new_u = prox[0, y, x] * a + prox[2, y, x] * b - prox[3, y, x]
                new_v = prox[1, y, x] * b + prox[2, y, x] * a - prox[4, y, x]
                now[0, y, x], now[1, y, x] = new_u, new_v
                ahead[0, y, x], ahead[1, y, x] = _TWO * new_u - u, _TWO * new_v - v
    flow[:] = now[:, :height, :width]


@vectorised
def box_into(field: Map, across: tuple[int, ...], out: Map) -> None:
    """See `image.box`: means of field (N, H, W) over squares of `len(across)` pixels, into `out`.

    A tuple's length is known when this is compiled: sums over it are unrolled, six times as fast.
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


def noise_weight(before: Map, after: Map, mask: Map, gamma: float, noise: float) -> float:
    """(noise / median of |r| where `mask` is)^2, 1 if nothing is seen; before, after as in `linearise`."""
    square = _squares(before, after, mask, np.float32(gamma))
    middle = (len(square) - 1) // 2
    return noise**2 / max(float(np.partition(square, middle)[middle]), 1e-12) if len(square) else 1.0


@vectorised
def _squares(before: Map, after: Map, mask: Map, gamma: np.float32) -> Map:
    """|r|^2 of every other pixel of every other row, where the mask is."""
    height, width = mask.shape
    square, count = np.empty(mask.size, np.float32), 0
    for y in range(0, height, 2):
        for x in range(0, width, 2):
            r0 = after[0, y, x] - before[0, y, x]
            r1, r2 = after[1, y, x] - before[1, y, x], after[2, y, x] - before[2, y, x]
            square[count] = r0 * r0 + gamma * gamma * (r1 * r1 + r2 * r2)
            count += mask[y, x] > _ZERO
    return square[:count]
