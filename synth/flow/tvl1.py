"""Masked TV-L1 optical flow: one solver for CPU and CUDA.

Minimises over the flow w = (u, v), with I_0 the rest frame and I_1 the frame now, both contrast-normalised,

    E(w) = sum_x  lambda m(x) psi(|r(x, w)|^2)  +  |grad u|_h + |grad v|_h ,
    r(x, w) = (W, gamma d_x W, gamma d_y W) - (I_0, gamma d_x I_0, gamma d_y I_0),   W(x) = I_1(x + w(x)),

psi(s^2) = sqrt(s^2 + epsilon^2) being the robust data term on brightness and gradient (Brox et al., High
accuracy optical flow estimation based on a theory for warping, ECCV 2004, eq. 5), |.|_h the Huber norm
(Werlberger et al., Anisotropic Huber-L1 optical flow, BMVC 2009, eq. 6), and m the mask: seen in the rest
frame, and seen now at x + w. Where m is 0 the regulariser alone carries the flow on, there as a membrane (a
larger h). lambda is that of a picture of little noise: it falls with the square of the residual's median, as
a measurement's weight does with its noise, and rises where the first guess is steep. Coarse to fine, re-
warped (Brox), each warp solved by the primal-dual steps of Chambolle and Pock (J. Math. Imaging Vis. 40,
2011, algorithm 1) on lagged weights.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from synth.flow import confidence, correction, fused, image
from synth.flow.estimator import Flags, Flow, Map, Rgb
from synth.flow.image import Level

_BETTER = 1.025  # the guess for large motion must fit this much better than the one for small motion
_AGREED = 0.6  # agreement below which the network is believed less, and noise not at all
_WEIGHT_LIMITS = 0.45, 1.5  # pictures of much noise, or none, would be smoothed to nothing or not at all


@dataclass(frozen=True)
class TVL1Settings:
    """The energy, and how far it is minimised."""

    weight: float = 0.36
    """lambda: data against smoothness."""
    noise: float = 0.115
    """Median residual [local deviations] that lambda is for. It falls with the square of what is found: that
    is the weight of a measurement with so much noise. 0: lambda stays."""
    gradient: float = 1.0
    """gamma: weight of gradient constancy."""
    huber: float = 0.15
    """h: flow gradients below it [px/px] are smoothed quadratically, above it linearly."""
    hidden_huber: float = 0.3
    """Added to h where nothing is seen: flow carries on there as a membrane would, without steps."""
    epsilon: float = 0.01
    """Residuals below it [local deviations] count quadratically."""
    coarsest_px: int = 12
    """The pyramid goes down to about this many pixels on the short side."""
    warps: int = 6
    """Linearisations a level."""
    steps: int = 16
    """Primal-dual steps a warp."""
    tau: float = 3.5
    """Primal step; the dual step is 1/(8 tau)."""
    median: bool = True
    """3x3 median of the flow after each warp (Wedel et al., An improved algorithm for TV-L1, 2009)."""
    steady_px: float = 0.1
    """The last flow is averaged over its neighbours where that changes it by less than about this: what goes
    there is noise, and a step in the flow stays."""
    steep: float = 0.1
    """Where the first guess's gradient [px/px] is this large, lambda doubles: smoothness costs most there."""
    fine_levels: int = 2
    """Levels that the second stage of a cold start works on; a warm start works on all."""
    large_motion_weight: float = 2.5
    """lambda of the first stage of a cold start: far pulls are steep, and smoothness would hold them back."""
    small_motion_weight: float = 1.0
    """lambda of its other try, which is taken unless the first fits clearly better."""
    coarse_tau: float = 1.0
    """Primal step of that stage: small, for the coarsest levels have few pixels and must not run away."""
    coarse_warps: int = 6
    """Linearisations a level of that stage, which leaves out the finest level."""

    def small_motion(self) -> TVL1Settings:
        """A first stage of a cold start, for what moves little."""
        weight, tau, warps = self.small_motion_weight, self.coarse_tau, self.coarse_warps
        return replace(self, weight=weight, noise=0.0, hidden_huber=0.0, tau=tau, warps=warps)

    def large_motion(self) -> TVL1Settings:
        """A first stage of a cold start, for what moves far."""
        return replace(self.small_motion(), weight=self.large_motion_weight)


class Tvl1:
    """The estimator `tvl1`: masked TV-L1, cold in two stages, warm in one.

    Both with as many warps: half of them smooth less, and the error of warm frames was 1.12 times as large.
    """

    def __init__(
        self,
        settings: TVL1Settings | None = None,
        device: str | None = None,
        *,
        corrected: bool = True,
    ) -> None:
        """Sets up.

        Args:
            settings: the energy and the effort; None: the default, a measured point.
            device: torch device; None: CUDA where there is one.
            corrected: add what a network says is missing, and take its deviation for the confidence, which is
                the pictures' agreement otherwise; see `synth.flow.correction`.
        """
        self.settings = settings or TVL1Settings()
        self.device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self.correction = correction.load() if corrected else None
        self._rest: tuple[Tensor, Tensor, list[tuple[Tensor, Tensor]]] | None = None
        """The last rest frame, where it was usable, and its pyramid: a video has one."""

    def flow(
        self, rest: Rgb, now: Rgb, rest_usable: Flags, now_usable: Flags, initial: Flow | None = None
    ) -> tuple[Flow, Map]:
        """See `Estimator.flow`."""
        with torch.inference_mode(), one_thread():
            start = None
            if initial is not None:
                # Planes, not interleaved: sums over neighbours took five times as long on the latter.
                planes = np.ascontiguousarray(np.moveaxis(initial, -1, 0))
                start = torch.from_numpy(planes)[None].to(self.device)
            found, agreed, aligned = self.tensors(
                image.tensor(rest, self.device),
                image.tensor(now, self.device),
                image.flags(rest_usable, self.device),
                image.flags(now_usable, self.device),
                start,
            )
            flow, sure = found[0].movedim(0, -1).cpu().numpy(), agreed[0, 0].cpu().numpy()
            if self.correction is None:
                return flow, sure
            *greys, seen = (plane[0, 0].cpu().numpy() for plane in aligned)
            described = correction.describe(rest, now, rest_usable, (greys[0], greys[1]), seen, flow, sure)
            flow, deviation = correction.correct(self.correction, described, flow)
            # Where pictures hardly agree, as under a tool that no mask knows, the network has learnt nothing.
            return flow, np.minimum(sure / _AGREED, 1) ** 2 * confidence.of_deviation(deviation)

    def tensors(
        self,
        rest: Tensor,
        now: Tensor,
        rest_usable: Tensor,
        now_usable: Tensor,
        initial: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
        """As `flow`, uncorrected, on the device: greys, masks, agreement (1, 1, H, W), flow (1, 2, H, W).

        The last are the rest frame, the one warped back, both contrast-normalised, and what is seen of it.
        """
        s = self.settings
        last = self._rest
        if last is None or not (torch.equal(rest, last[0]) and torch.equal(rest_usable, last[1])):
            self._rest = last = rest, rest_usable, pyramid(rest, rest_usable, s)
        both = zip(last[2], pyramid(now, now_usable, s), strict=True)
        levels = [Level(before, after, seen, still) for (before, seen), (after, still) in both]
        fine = levels
        if initial is None and len(levels) > 1:
            initial, fine = finer(guess(levels[1:], s), levels[0]), levels[: s.fine_levels]
        found = steadied(solve(fine, initial, s), s.steady_px)
        warped, seen = image.warp(levels[0].now, levels[0].now_usable, found)
        return found, confidence.agreement(levels[0], warped, seen), (levels[0].rest, warped, seen)


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread for the block: these tensors are so small that threads only wait for one another."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def pyramid(grey: Tensor, usable: Tensor, s: TVL1Settings) -> list[tuple[Tensor, Tensor]]:
    """Half of every `Level`, fine to coarse, of one picture; pixel x of one is (x - 1/2)/2 of the next."""
    levels = []
    while True:
        levels.append((image.normalise(grey, usable), (usable > 0.5).to(grey.dtype)))
        if min(grey.shape[-2:]) < 2 * s.coarsest_px:
            return levels
        pooled = image.halved(torch.cat([grey * usable, usable], 1))
        usable = pooled[:, 1:]
        grey = pooled[:, :1] / usable.clamp_min(1e-6)


def guess(levels: list[Level], s: TVL1Settings) -> Tensor:
    """The first stage of a cold start, twice: the picture's better answer, (B, 2, H, W) px.

    Little smoothness follows far pulls but loses islands between the tines, much smoothness the reverse.
    """
    small, large = solve(levels, None, s.small_motion()), solve(levels, None, s.large_motion())
    warped = [image.warp(levels[0].now, levels[0].now_usable, flow) for flow in (small, large)]
    trust = [confidence.agreement(levels[0], *one).mean((1, 2, 3), keepdim=True) for one in warped]
    return torch.where(trust[1] > _BETTER * trust[0], large, small)


def solve(levels: list[Level], initial: Tensor | None, s: TVL1Settings) -> Tensor:
    """Flow (B, 2, H, W) px of the finest level.

    Args:
        levels: fine to coarse.
        initial: (B, 2, H, W) px at the finest level, or None.
        s: settings.
    """
    coarsest = levels[-1].now
    flow = coarsest.new_zeros(coarsest.shape[0], 2, *coarsest.shape[-2:])
    weight = torch.full_like(flow[:, :1, :1, :1], s.weight)
    if initial is not None:
        flow = initial
        if s.steep > 0:
            weight = weight * (1 + steepness(flow) / s.steep**2)
        for _ in levels[1:]:
            flow = 0.5 * image.halved(flow)
    for level in reversed(levels):
        if flow.shape[-2:] != level.now.shape[-2:]:
            flow = finer(flow, level)
        here = weight
        if weight.shape[-1] > 1:
            here = F.interpolate(weight, size=flow.shape[-2:], mode="bilinear", align_corners=False)
        if flow.device.type == "cpu":
            flow = _solve_level(level, flow, here, s)
            continue
        dual = flow.new_zeros(2, *flow.shape)
        for _ in range(s.warps):
            flow, dual = step(level, flow, dual, here, s)
    return flow


def _solve_level(level: Level, flow: Tensor, weight: Tensor, s: TVL1Settings) -> Tensor:
    """All warps of a level on the CPU, in compiled loops that compute what `step` does."""
    rest, now, rest_usable, now_usable = (
        np.ascontiguousarray(field[0, 0].numpy())
        for field in (level.rest, level.now, level.rest_usable, level.now_usable)
    )
    found = flow[0].contiguous().numpy().copy()
    numbers = np.array([s.tau, s.gradient, s.epsilon, s.huber, s.hidden_huber], np.float32)
    before, after = np.empty((2, 6, *rest.shape), np.float32)
    mask, spare = np.empty((2, *rest.shape), np.float32)
    lambda_ = here = np.ascontiguousarray(np.broadcast_to(weight[0, 0].numpy(), rest.shape))
    state = fused.new_state(*rest.shape)

    def differentiate(planes: Map) -> None:
        """d_x, d_y, d_xx, d_xy, d_yy of the first plane into the others."""
        fused.differentiate(planes[0], planes[1], planes[2])
        fused.differentiate(planes[1], planes[3], planes[4])
        fused.differentiate(planes[2], spare, planes[5])

    before[0] = rest
    differentiate(before)
    for _ in range(s.warps):
        fused.warp_into(now, now_usable, found, after[0], mask)
        mask *= rest_usable
        differentiate(after)
        if s.noise > 0:
            share = fused.noise_weight(before, after, mask, s.gradient, s.noise)
            here = lambda_ * np.float32(np.clip(share, *_WEIGHT_LIMITS))
        fused.linearise(before, after, mask, here, found, numbers, state)
        fused.primal_dual(found, state, np.float32(s.tau), s.steps)
        if s.median:
            found = np.stack([cv2.medianBlur(plane, 3) for plane in found])
    return torch.from_numpy(found)[None]


def steadied(flow: Tensor, within_px: float) -> Tensor:
    """Flow (B, 2, H, W) px, averaged about as by a Gaussian of 1.4 px where that changes it little."""
    smooth = flow
    for _ in range(3):
        smooth = image.box(smooth, 1)
    change = smooth - flow
    return flow + change * torch.exp(-(change * change).sum(1, keepdim=True) / within_px**2)


def finer(flow: Tensor, level: Level) -> Tensor:
    """The next coarser level's flow (B, 2, h, w) on the grid of `level`, (B, 2, H, W) in its pixels."""
    return 2 * image.doubled(flow, level.now)


def step(level: Level, flow: Tensor, dual: Tensor, weight: Tensor, s: TVL1Settings) -> tuple[Tensor, Tensor]:
    """One warp: linearise r about `flow`, weigh it, minimise. dual: (2, B, 2, H, W), its x and y parts."""
    warped, seen = image.warp(level.now, level.now_usable, flow)
    mask = level.rest_usable * seen
    # The gradient of the *warped* picture is what the rest frame's must equal: it turns and stretches with w.
    before = torch.cat([level.rest, s.gradient * image.derivative(level.rest)], 1)
    after = torch.cat([warped, s.gradient * image.derivative(warped)], 1)
    residual = after - before  # (B, 3, H, W)
    slope = image.derivative(0.5 * (after + before))  # (B, 6, H, W): x of the 3, then y of the 3
    rows, columns = slope[:, :3], slope[:, 3:]
    if s.noise > 0:
        weight = weight * noise_weight(residual, mask, s.noise)
    c = s.tau * weight * mask / torch.sqrt((residual * residual).sum(1, keepdim=True) + s.epsilon**2)
    # (1 + c J^T J) w = v - c J^T (r - J w_0), 2x2 by Cramer.
    xx = 1 + c * (rows * rows).sum(1, keepdim=True)
    xy = c * (rows * columns).sum(1, keepdim=True)
    yy = 1 + c * (columns * columns).sum(1, keepdim=True)
    offset = residual - rows * flow[:, :1] - columns * flow[:, 1:]
    gx, gy = c * (rows * offset).sum(1, keepdim=True), c * (columns * offset).sum(1, keepdim=True)
    scale = 1 / (xx * yy - xy * xy)
    straight = torch.cat([yy, xx], 1) * scale
    cross = -xy * scale
    shift = straight * torch.cat([gx, gy], 1) + cross * torch.cat([gy, gx], 1)
    flow, dual = primal_dual(flow, dual, straight, cross, shift, s.huber + s.hidden_huber * (1 - mask), s)
    if s.median:
        flow = image.median3(flow)
    return flow, dual


def noise_weight(residual: Tensor, mask: Tensor, noise: float) -> Tensor:
    """(noise / median of |r| in the mask) squared, within limits; 1 if nothing is seen. (B, 1, 1, 1)."""
    some = residual[..., ::2, ::2]
    square = torch.where(mask[..., ::2, ::2] > 0, (some * some).sum(1, keepdim=True), torch.nan)
    found = torch.nan_to_num(square.flatten(1).nanmedian(dim=1).values, nan=noise**2)
    return (noise**2 / found.clamp_min(1e-12)).clamp(*_WEIGHT_LIMITS).view(-1, 1, 1, 1)


def steepness(flow: Tensor) -> Tensor:
    """|grad w|^2 of w averaged over 16 x 16 px, (B, 1, H, W): what of the slope isn't noise."""
    coarse = F.avg_pool2d(flow, 16, ceil_mode=True, count_include_pad=False)
    wide = F.pad(coarse, (1, 1, 1, 1), "replicate")
    dx, dy = wide[..., 1:-1, 2:] - wide[..., 1:-1, :-2], wide[..., 2:, 1:-1] - wide[..., :-2, 1:-1]
    slope = (dx * dx + dy * dy).sum(1, keepdim=True) / 32**2
    return F.interpolate(slope, size=flow.shape[-2:], mode="bilinear", align_corners=False)


def primal_dual(
    flow: Tensor, dual: Tensor, straight: Tensor, cross: Tensor, shift: Tensor, huber: Tensor, s: TVL1Settings
) -> tuple[Tensor, Tensor]:
    """`steps` of: dual ascent on grad w with the Huber prox, primal descent with the data term's 2x2 prox.

    Args:
        flow: (B, 2, H, W) px.
        dual: (2, B, 2, H, W), its x and y parts.
        straight, cross, shift: (B, 2, H, W), (B, 1, H, W), (B, 2, H, W): the prox as an affine map.
        huber: (B, 1, H, W) or a number, h [px/px].
        s: settings.
    """
    sigma = 1 / (8 * s.tau)
    dual, ahead = dual.clone(), flow
    px, py = dual[0], dual[1]
    shrink = 1 / (1 + sigma * huber)
    for _ in range(s.steps):
        px[..., :-1].add_(ahead[..., 1:] - ahead[..., :-1], alpha=sigma)
        py[..., :-1, :].add_(ahead[..., 1:, :] - ahead[..., :-1, :], alpha=sigma)
        dual.mul_(shrink)
        dual.mul_((px * px).addcmul_(py, py).clamp_min_(1).rsqrt_())  # p / max(1, |p|)
        v = torch.add(flow, px, alpha=s.tau).add_(py, alpha=s.tau)  # v = w + tau div p
        v[..., 1:].sub_(px[..., :-1], alpha=s.tau)
        v[..., 1:, :].sub_(py[..., :-1, :], alpha=s.tau)
        new = (straight * v).sub_(shift)
        new[:, :1].addcmul_(cross, v[:, 1:])
        new[:, 1:].addcmul_(cross, v[:, :1])
        flow, ahead = new, torch.lerp(flow, new, 2.0)  # 2 new - old
    return flow, dual
