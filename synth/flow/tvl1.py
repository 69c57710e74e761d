"""Masked TV-L1 optical flow with a compiled solver.

Minimises over the flow w = (u, v), with I_0 the rest frame and I_1 the frame now, both contrast-normalised,

    E(w) = sum_x  lambda m(x) psi(|r(x, w)|^2)  +  |grad u|_h + |grad v|_h ,
    r(x, w) = (W, gamma d_x W, gamma d_y W) - (I_0, gamma d_x I_0, gamma d_y I_0),   W(x) = I_1(x + w(x)),

psi(s^2) = sqrt(s^2 + epsilon^2) is the robust data term on brightness and gradient (Brox et al., High
accuracy optical flow estimation based on a theory for warping, ECCV 2004, eq. 5), |.|_h the Huber norm
(Werlberger et al., Anisotropic Huber-L1 optical flow, BMVC 2009, eq. 6), and m the mask: visible in the
rest frame, and visible now at x + w. Where m is 0 the regulariser alone determines the flow, with a larger h,
that is, smoothed quadratically. On the finest level grad is of w less its local mean. lambda rises where the
initial flow is steep. On the finest level it is scaled by (reference / median residual)^2, limited to
0.45-1.5; on coarse ones, where noise has averaged out and a residual is motion not yet found, which a smaller
lambda would never find, by a constant. The solver works coarse to fine with repeated warping (Brox); each
warp is solved by the primal-dual algorithm 1 of Chambolle and Pock (J. Math. Imaging Vis. 40, 2011) with
lagged weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from synth.arrays import Map, Mask, Pixels
from synth.flow import confidence, correction, image, kernels
from synth.flow.image import Level
from synth.system.jit import argument_types, vectorised

_BETTER = 1.025  # factor in agreement by which the guess for large motion must exceed that for small motion
_AGREED = 0.6  # agreement below which the confidence of the network is lowered
_WEIGHT_LIMITS = 0.45, 1.5  # of the noise weight: avoids too much or too little smoothing
_FINE = 1  # levels that `follow` solves once
_LANES = 16  # floats of the widest vector registers
_ZERO, _HALF, _ONE, _TWO, _EIGHT = (np.float32(number) for number in (0, 0.5, 1, 2, 8))


@dataclass(frozen=True)
class TVL1Settings:
    """Parameters of the energy and of the solver. A cold start has two stages: a guess on the coarse levels
    with two values of lambda, then the solution on the fine levels. A warm start solves on all levels."""

    weight: float = 0.18  # lambda: data against smoothness
    noise: float = 0.115  # finest level: reference median residual [local standard deviations]; 0: no scaling
    gradient: float = 1.0  # gamma: weight of gradient constancy
    huber: float = 0.15  # h [px/px]: smaller flow gradients are smoothed quadratically, larger ones linearly
    hidden_huber: float = 0.3  # added to h where nothing is visible: the flow has no steps there
    epsilon: float = 0.01  # residuals below it count quadratically [local std]
    coarsest_px: int = 12  # shorter side of the coarsest level, about
    warps: int = 8  # linearisations of the finest level
    steps: int = 16  # primal-dual steps per warp there
    settled_px: float = 0.005  # RMS change of the visible by a warp that ends it [px]
    coarse_weight: float = 1.4  # factor of lambda on coarse levels
    coarse_warps: int = 4  # linearisations per coarse level
    coarse_steps: int = 24  # primal-dual steps per warp there
    coarse_settled_px: float = 0.01  # RMS change of the visible by a warp that ends one [px of the level]
    tau: float = 3.5  # primal step; the dual step is 1/(8 tau)
    median: bool = True  # 3x3 median after each warp (Wedel et al., An improved algorithm for TV-L1, 2009)
    bending_px: float = (
        8.0  # finest level: smoothness is of the flow less its mean over this; 0: of all of it
    )
    steady_px: float = 0.1  # the final flow is smoothed where that changes it by less: noise, not a step
    steep: float = 0.1  # gradient of the initial flow at which lambda doubles [px/px]
    agreement_range: float = 0.1  # see `follow`: change of agreement over which it turns
    large_px: float = 2.0  # there: length from which motion is large
    second_stage_levels: int = 2  # the finest
    large_motion_weight: float = 2.5  # lambda of the first stage: smoothness would hold large motion back
    small_motion_weight: float = 1.0  # lambda of its alternative, used unless the first agrees clearly better
    first_tau: float = 1.0  # primal step of the first stage: small, as from no flow coarse levels may diverge

    def derive_first_stage(self, weight: float) -> TVL1Settings:
        """Settings of the first stage of a cold start, which omits the finest level."""
        return replace(self, weight=weight, hidden_huber=0.0, tau=self.first_tau, coarse_weight=1.0)

    def derive_coarse(self) -> TVL1Settings:
        """Settings of all levels but the finest."""
        return replace(
            self,
            noise=0.0,
            bending_px=0.0,
            warps=self.coarse_warps,
            steps=self.coarse_steps,
            settled_px=self.coarse_settled_px,
        )


class Tvl1:
    """The estimator `tvl1`: masked TV-L1 with two stages for a cold start and one for a warm start."""

    def __init__(self, settings: TVL1Settings = TVL1Settings(), *, corrected: bool = True) -> None:
        """`corrected`: a network corrects the flow and gives its confidence, which otherwise is the local
        correlation of the rest and the warped frame; see `synth.flow.correction`."""
        self.settings = settings
        self.corrected = corrected
        # The last rest frame, its mask and its pyramid, which are the same for all frames of a video.
        self._rest: tuple[Map, Map, list[tuple[Map, Map]]] | None = None

    def flow(
        self, rest: Pixels, now: Pixels, rest_usable: Mask, now_usable: Mask, initial: Map | None = None
    ) -> tuple[Map, Map]:
        """See `Estimator.flow`."""
        # Planes: sums over neighbours take five times as long on interleaved components.
        start = None if initial is None else np.ascontiguousarray(np.moveaxis(initial, -1, 0), np.float32)
        pictures = image.luminance(rest), image.luminance(now)
        usable = image.flags(rest_usable), image.flags(now_usable)
        planes, agreement, (before, after, visible) = self.estimate_uncorrected(*pictures, *usable, start)
        flow = np.moveaxis(planes, 0, -1)
        if not self.corrected:
            return flow, agreement
        features = correction.describe(rest, now, rest_usable, (before, after), visible, flow, agreement)
        proximity = correction.nearness(rest_usable, now_usable)
        flow, deviation = correction.correct(features, flow, proximity)
        # The network was not trained where pictures disagree, as under an unmasked instrument.
        return flow, np.minimum(agreement / _AGREED, 1) ** 2 * confidence.of_deviation(deviation)

    def estimate_uncorrected(
        self, rest: Map, now: Map, rest_usable: Map, now_usable: Map, initial: Map | None
    ) -> tuple[Map, Map, tuple[Map, Map, Map]]:
        """Uncorrected flow (2, H, W) px of greys and masks (H, W) float32, and of an initial flow.

        Returns the flow, its agreement, and the normalised rest frame, the warped frame and its mask.
        """
        s = self.settings
        last = self._rest
        if last is None or not (np.array_equal(rest, last[0]) and np.array_equal(rest_usable, last[1])):
            self._rest = last = rest, rest_usable, pyramid(rest, rest_usable, s)
        pairs = zip(last[2], pyramid(now, now_usable, s), strict=True)
        levels = [Level(before, after, known, known_now) for (before, known), (after, known_now) in pairs]
        if initial is not None:
            flow = follow(levels, initial, s)
        elif len(levels) > 1:
            flow = solve(levels[: s.second_stage_levels], upsample(guess(levels, s), levels[0]), s)
        else:
            flow = solve(levels, None, s)
        flow = smooth_noise(flow, s.steady_px)
        warped, visible = image.warp(levels[0].now, levels[0].now_usable, flow)
        return flow, confidence.agreement(levels[0], warped, visible), (levels[0].rest, warped, visible)


def pyramid(grey: Map, usable: Map, s: TVL1Settings) -> list[tuple[Map, Map]]:
    """Normalised picture and mask of each level, fine to coarse; pixel x is (x - 1/2)/2 on the next level."""
    levels = []
    while True:
        levels.append((image.normalise(grey, usable), usable * (usable > 0.1)))
        if min(grey.shape) < 2 * s.coarsest_px:
            return levels
        grey, usable = image.halve(np.stack([grey * usable, usable]))
        grey = np.asarray(grey / np.maximum(usable, 1e-6), np.float32)


def guess(levels: list[Level], s: TVL1Settings) -> Map:
    """The first stage of a cold start, on all levels but the finest, with two values of lambda; returns the
    better flow (2, h, w) px of the second level.

    A large lambda follows large motion but fails on small areas between forceps tips; a small one does the
    opposite.
    """
    weights = s.small_motion_weight, s.large_motion_weight
    coarse = levels[1:]
    small, large = (solve(coarse, None, s.derive_first_stage(weight), skipped=1) for weight in weights)
    warped = [image.warp(coarse[0].now, coarse[0].now_usable, flow) for flow in (small, large)]
    trust = [float(confidence.agreement(coarse[0], *pictures).mean()) for pictures in warped]
    return large if trust[1] > _BETTER * trust[0] else small


def solve(levels: list[Level], initial: Map | None, s: TVL1Settings, skipped: int = 0) -> Map:
    """Flow (2, H, W) px of the first of the levels, which are from fine to coarse.

    `initial`: as the result; `skipped`: how many finer levels there are.
    """
    shape = levels[0].now.shape
    flow = np.zeros((2, *shape), np.float32) if initial is None else initial
    return _refine(levels, _pyramid(flow, len(levels))[-1], _weights(shape, initial, s), s, skipped=skipped)


def follow(levels: list[Level], last: Map, s: TVL1Settings) -> Map:
    """As `solve`, from the flow of the last frame.

    On coarse levels smoothness erases large motion of a small area, even the true one, and finer levels don't
    see so far: of 7 to 24 px at contacts of `mission` and `clinical` a third to two thirds was lost. If the
    last flow is large, coarse levels are therefore solved a second time, smoothing only what they add to it.
    That is used where pictures agree better with it: used everywhere, it never lets go of a wrong match.
    """
    if len(levels) <= _FINE or np.hypot(*last).max() <= s.large_px:
        return solve(levels, last, s)
    weight, start = _weights(last.shape[1:], last, s), _pyramid(last, len(levels))
    coarse = levels[_FINE:]
    flows = [
        _refine(coarse, start[-1], weight, s, references, skipped=_FINE)
        for references in (None, start[_FINE:])
    ]
    warped = [image.warp(coarse[0].now, coarse[0].now_usable, flow) for flow in flows]
    trust = [confidence.agreement(coarse[0], *pictures) for pictures in warped]
    share = np.clip(_HALF + (trust[1] - trust[0]) / np.float32(s.agreement_range), 0, 1)
    flow = upsample(flows[0] + share * (flows[1] - flows[0]), levels[_FINE - 1])
    return _refine(levels[:_FINE], flow, weight, s)


def _weights(shape: tuple[int, ...], initial: Map | None, s: TVL1Settings) -> Map:
    """lambda at each pixel (H, W), which rises where the initial flow is steep."""
    weight = np.full(shape, s.weight, np.float32)
    if initial is not None and s.steep > 0:
        weight = weight * (1 + steepness(initial) / np.float32(s.steep**2))
    return weight


def _pyramid(flow: Map, count: int) -> list[Map]:
    """A flow (2, H, W) px on so many levels, in pixels of each."""
    levels = [flow]
    for _ in range(count - 1):
        levels.append(np.float32(0.5) * image.halve(levels[-1]))
    return levels


def _refine(
    levels: list[Level],
    flow: Map,
    weight: Map,
    s: TVL1Settings,
    references: list[Map] | None = None,
    skipped: int = 0,
) -> Map:
    """Flow of the first of the levels from that of the last, the coarsest; `references`: on each level, see
    `_solve_level`; `skipped`: as of `solve`."""
    for k in reversed(range(len(levels))):
        shape = levels[k].now.shape
        if flow.shape[1:] != shape:
            flow = upsample(flow, levels[k])
        level_weight = image.resize(weight[None], shape)[0]
        settings = s
        if k + skipped > 0:
            level_weight, settings = np.float32(s.coarse_weight) * level_weight, s.derive_coarse()
        reference = None if references is None else references[k]
        flow = _solve_level(levels[k], flow, level_weight, settings, reference)
    return flow


def _solve_level(level: Level, flow: Map, weight: Map, s: TVL1Settings, reference: Map | None) -> Map:
    """All warps of a level: each linearises r about the flow, weights it and minimises the energy.

    The smoothness term sees the flow less `reference` (2, H, W), or less its Gaussian mean: of all of it, it
    damps a wave of wavenumber k by 1 / (1 + (k / k_0)^2), and a tenth is lost at k_0 / 3 already.
    """
    rest, now, rest_usable, now_usable = level.rest, level.now, level.rest_usable, level.now_usable
    solution = flow.copy()
    numbers = np.array([s.tau, s.gradient, s.epsilon, s.huber, s.hidden_huber], np.float32)
    before, after = np.empty((2, 6, *rest.shape), np.float32)
    mask, unused = np.empty((2, *rest.shape), np.float32)
    scaled_weight = weight
    state = new_state(*rest.shape)
    mean: Map | np.float32

    def differentiate(planes: Map) -> None:
        """Writes d_x, d_y, d_xx, d_xy, d_yy of the first plane to the others."""
        kernels.differentiate(planes[0], planes[1], planes[2])
        kernels.differentiate(planes[1], planes[3], planes[4])
        kernels.differentiate(planes[2], unused, planes[5])

    before[0] = rest
    differentiate(before)
    for _ in range(s.warps):
        kernels.warp_into(now, now_usable, solution, after[0], mask)
        mask *= rest_usable
        differentiate(after)
        if s.noise > 0:
            share = noise_weight(before, after, mask, s.gradient, s.noise)
            scaled_weight = weight * np.float32(np.clip(share, *_WEIGHT_LIMITS))
        last, mean = solution, _ZERO if reference is None else reference
        if s.bending_px > 0:
            mean = image.double(image.window(last, s.bending_px), rest.shape)
        solution = last - mean
        linearise(before, after, mask, scaled_weight, solution, numbers, state)
        primal_dual(solution, state, np.float32(s.tau), s.steps)
        if s.median:
            solution = np.stack([cv2.medianBlur(plane, 3) for plane in solution])
        solution = solution + mean
        change = solution - last
        if (mask * change**2).sum() < s.settled_px**2 * mask.sum():
            break
    return solution


def smooth_noise(flow: Map, within_px: float) -> Map:
    """Smooths a flow (2, H, W) px by about a Gaussian of 1.4 px where that changes it by little."""
    blurred = flow
    for _ in range(3):
        blurred = image.box(blurred, 1)
    change = blurred - flow
    return np.asarray(flow + change * np.exp(-(change * change).sum(0) / within_px**2), np.float32)


def upsample(flow: Map, level: Level) -> Map:
    """Upsamples the flow (2, h, w) of the next coarser level to `level`: (2, H, W) in its pixels."""
    return np.asarray(2 * image.double(flow, level.now.shape), np.float32)


def steepness(flow: Map) -> Map:
    """|grad w|^2 (H, W) of w averaged over 16 x 16 px, which removes the noise."""
    size, rows, columns = 16, *(np.arange(0, n, 16) for n in flow.shape[1:])
    sums = np.add.reduceat(np.add.reduceat(flow, rows, 1), columns, 2)
    areas = [np.minimum(size, n - starts) for n, starts in zip(flow.shape[1:], (rows, columns), strict=True)]
    extended = np.pad(sums / np.outer(*areas).astype(np.float32), ((0, 0), (1, 1), (1, 1)), "edge")
    dx, dy = extended[:, 1:-1, 2:] - extended[:, 1:-1, :-2], extended[:, 2:, 1:-1] - extended[:, :-2, 1:-1]
    slope = (dx * dx + dy * dy).sum(0) / np.float32((2 * size) ** 2)
    upsampled: Map = image.resize(slope[None], flow.shape[1:])[0]
    return upsampled


@argument_types("f4[:,:,::1], f4[:,:,::1], f4[:,::1], f4[:,::1], f4[:,:,::1], f4[::1], f4[:,:,::1]")
@vectorised
def linearise(before: Map, after: Map, mask: Map, weight: Map, flow: Map, numbers: Map, state: Map) -> None:
    """Computes the proximal map of the data term, affine in (v_x, v_y), and the factor 1 / (1 + sigma h).

    Args:
        before, after: (6, H, W), I, d_x, d_y, d_xx, d_xy, d_yy of the rest frame and of the warped frame.
        mask, weight, flow: (H, W), and (2, H, W) px, the point of linearisation.
        numbers: tau, gamma, epsilon, h, and its increase where nothing is visible.
        state: see `new_state`; its last six planes are written.
    """
    height, width = mask.shape
    tau, gamma, epsilon, huber, hidden_huber = numbers
    for y in range(height):
        for x in range(width):
            u, v = flow[0, y, x], flow[1, y, x]
            # Residual r; slopes a by x and b by y of the mean of both pictures; a2 equals b1.
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
    """Planes of `primal_dual`: w (2), its extrapolation (2), the dual of grad w by x (2) and y (2), both 0,
    the proximal map's 2x2 matrix: diagonal (2), off-diagonal (1), offset (2); and 1 / (1 + sigma h).

    Rows are aligned and padded to whole vectors: without, loops take 1.6 times as long. The dual is shifted
    down by one row, its x part right by `_LANES`, so that zeros precede it.
    """
    shape = 14, height + 1, -(-width // _LANES) * _LANES + _LANES
    flat = np.empty(int(np.prod(shape)) + _LANES, np.float32)
    state: Map = flat[-(flat.ctypes.data // 4) % _LANES :][: int(np.prod(shape))].reshape(shape)
    state[4:8] = state[..., width:] = 0
    return state


def primal_dual(flow: Map, state: Map, tau: np.float32, steps: int) -> None:
    """`steps` of Chambolle and Pock's algorithm 1 on a flow (2, H, W) px, in place.

    A row of step k depends only on this row and the next of step k - 1. All steps therefore go down the
    picture together, each one row behind the previous one, so that shared rows stay in the cache. `state`:
    see `new_state`; `tau`: primal step; the dual step sigma is 1 / (8 tau).
    """
    height, width = flow.shape[1:]
    sigma = _ONE / (_EIGHT * tau)
    sigma_x = np.full(state.shape[2] - _LANES, sigma)
    sigma_x[width - 1 :] = _ZERO  # the dual of the last column stays 0: no gradient crosses the border
    state[:2, :height, :width] = state[2:4, :height, :width] = flow
    _descend(state, height, tau, sigma, sigma_x, steps)
    flow[:] = state[:2, :height, :width]


@argument_types("f4[:,:,::1], i8, f4, f4, f4[::1], i8")
@vectorised
def _descend(state: Map, height: int, tau: np.float32, sigma: np.float32, sigma_x: Map, steps: int) -> None:
    width = len(sigma_x)
    now, ahead, px, py, prox, shrink = state[:2], state[2:4], state[4:6], state[6:8], state[8:13], state[13]
    for sweep in range(height + steps - 1):
        for k in range(max(0, sweep - height + 1), min(steps, sweep + 1)):
            y = sweep - k
            below = min(y + 1, height - 1)
            for c in range(2):
                for x in range(width):
                    centre = ahead[c, y, x]
                    p = px[c, y + 1, x + _LANES] + sigma_x[x] * (ahead[c, y, x + 1] - centre)
                    q = py[c, y + 1, x] + sigma * (ahead[c, below, x] - centre)
                    p, q = p * shrink[y, x], q * shrink[y, x]
                    norm = _ONE / np.sqrt(max(_ONE, p * p + q * q))
                    px[c, y + 1, x + _LANES], py[c, y + 1, x] = p * norm, q * norm
            for x in range(width):
                u, v = now[0, y, x], now[1, y, x]
                a = px[0, y + 1, x + _LANES] - px[0, y + 1, x + _LANES - 1] + py[0, y + 1, x] - py[0, y, x]
                b = px[1, y + 1, x + _LANES] - px[1, y + 1, x + _LANES - 1] + py[1, y + 1, x] - py[1, y, x]
                a, b = u + tau * a, v + tau * b
                new_u = prox[0, y, x] * a + prox[2, y, x] * b - prox[3, y, x]
                new_v = prox[1, y, x] * b + prox[2, y, x] * a - prox[4, y, x]
                now[0, y, x], now[1, y, x] = new_u, new_v
                ahead[0, y, x], ahead[1, y, x] = _TWO * new_u - u, _TWO * new_v - v


def noise_weight(before: Map, after: Map, mask: Map, gamma: float, noise: float) -> float:
    """(noise / median of |r| inside `mask`)^2; 1 if the mask is empty. Arguments as in `linearise`."""
    square = _squares(before, after, mask, np.float32(gamma))
    middle = (len(square) - 1) // 2
    return noise**2 / max(float(np.partition(square, middle)[middle]), 1e-12) if len(square) else 1.0


@argument_types("f4[:,:,::1], f4[:,:,::1], f4[:,::1], f4")
@vectorised
def _squares(before: Map, after: Map, mask: Map, gamma: np.float32) -> Map:
    """|r|^2 at every other pixel of every other row, inside the mask."""
    height, width = mask.shape
    square, count = np.empty(mask.size, np.float32), 0
    for y in range(0, height, 2):
        for x in range(0, width, 2):
            r0 = after[0, y, x] - before[0, y, x]
            r1, r2 = after[1, y, x] - before[1, y, x], after[2, y, x] - before[2, y, x]
            square[count] = r0 * r0 + gamma * gamma * (r1 * r1 + r2 * r2)
            count += mask[y, x] > _ZERO
    return square[:count]
