"""Masked TV-L1 on whole tensors with the equations and symbols of `synth.flow.tvl1`, as its reference."""

import torch
import torch.nn.functional as F
from torch import Tensor

from synth.flow import image
from synth.flow.image import Level
from synth.flow.tvl1 import TVL1Settings

_WEIGHT_LIMITS = 0.45, 1.5


def solve_level(level: Level, flow: Tensor, weight: Tensor, s: TVL1Settings, bending_px: float) -> Tensor:
    """Runs all warps of a level; flow (B, 2, H, W) px, weight (B, 1, H, W)."""
    dual = flow.new_zeros(2, *flow.shape)
    for _ in range(s.warps):
        mean = image.doubled(image.window(flow, bending_px), flow) if bending_px else torch.zeros_like(flow)
        flow, dual = step(level, flow, mean, dual, weight, s)
    return flow


Step = tuple[Tensor, Tensor]


def step(level: Level, flow: Tensor, mean: Tensor, dual: Tensor, weight: Tensor, s: TVL1Settings) -> Step:
    """One warp: linearises r about `flow`, weights it, minimises over the flow less its `mean`."""
    warped, visible = warp(level.now, level.now_usable, flow)
    mask = level.rest_usable * visible
    # The gradient of the warped picture, which rotates and stretches with w, must equal that at rest.
    before = torch.cat([level.rest, s.gradient * derivative(level.rest)], 1)
    after = torch.cat([warped, s.gradient * derivative(warped)], 1)
    residual = after - before  # (B, 3, H, W)
    slope = derivative(0.5 * (after + before))  # (B, 6, H, W): x of the 3, then y of the 3
    rows, columns = slope[:, :3], slope[:, 3:]
    if s.noise > 0:
        weight = weight * noise_weight(residual, mask, s.noise)
    c = s.tau * weight * mask / torch.sqrt((residual * residual).sum(1, keepdim=True) + s.epsilon**2)
    # (1 + c J^T J) w = v - c J^T (r - J w_0), 2x2 by Cramer.
    xx = 1 + c * (rows * rows).sum(1, keepdim=True)
    xy = c * (rows * columns).sum(1, keepdim=True)
    yy = 1 + c * (columns * columns).sum(1, keepdim=True)
    flow = flow - mean
    offset = residual - rows * flow[:, :1] - columns * flow[:, 1:]
    gx, gy = c * (rows * offset).sum(1, keepdim=True), c * (columns * offset).sum(1, keepdim=True)
    scale = 1 / (xx * yy - xy * xy)
    straight = torch.cat([yy, xx], 1) * scale
    cross = -xy * scale
    shift = straight * torch.cat([gx, gy], 1) + cross * torch.cat([gy, gx], 1)
    flow, dual = primal_dual(flow, dual, straight, cross, shift, s.huber + s.hidden_huber * (1 - mask), s)
    if s.median:
        flow = median3(flow)
    return flow + mean, dual


def noise_weight(residual: Tensor, mask: Tensor, noise: float) -> Tensor:
    """(noise / median of |r| in the mask) squared, within limits; 1 for an empty mask. (B, 1, 1, 1)."""
    some = residual[..., ::2, ::2]
    square = torch.where(mask[..., ::2, ::2] > 0, (some * some).sum(1, keepdim=True), torch.nan)
    found = torch.nan_to_num(square.flatten(1).nanmedian(dim=1).values, nan=noise**2)
    return (noise**2 / found.clamp_min(1e-12)).clamp(*_WEIGHT_LIMITS).view(-1, 1, 1, 1)


def primal_dual(
    flow: Tensor, dual: Tensor, straight: Tensor, cross: Tensor, shift: Tensor, huber: Tensor, s: TVL1Settings
) -> tuple[Tensor, Tensor]:
    """`steps` of: dual ascent on grad w with the Huber prox, primal descent with the data term's 2x2 prox.

    Args:
        flow: (B, 2, H, W) px.
        dual: (2, B, 2, H, W), its x and y parts.
        straight, cross, shift: (B, 2, H, W), (B, 1, H, W), (B, 2, H, W), the affine proximal map.
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


def warp(now: Tensor, usable: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
    """As `image.warp`, (B, C, H, W)."""
    height, width = now.shape[-2:]
    x = torch.arange(width, dtype=now.dtype)
    y = torch.arange(height, dtype=now.dtype)[:, None]
    at = torch.stack([(2 * (x + flow[:, 0]) + 1) / width - 1, (2 * (y + flow[:, 1]) + 1) / height - 1], -1)
    picture = F.grid_sample(now, at, mode="bicubic", padding_mode="border", align_corners=False)
    share = F.grid_sample(usable, at, mode="bilinear", padding_mode="zeros", align_corners=False)
    most = F.max_pool2d(F.pad(usable, (1, 1, 1, 1)), 2, 1)  # of four pixels
    column = (x + flow[:, 0]).floor().long().clamp(-1, width - 1) + 1
    row = (y + flow[:, 1]).floor().long().clamp(-1, height - 1) + 1
    most = torch.stack([one[:, i, j] for one, i, j in zip(most, row, column, strict=True)])
    return picture, torch.where(share > 0.9 * most, most, torch.zeros_like(most))


def derivative(field: Tensor) -> Tensor:
    """d/dx of every channel, then d/dy of every channel: (B, 2C, H, W); fourth-order central differences."""
    wide = F.pad(field, (2, 2, 2, 2), "replicate")
    x, y = wide[..., 2:-2, :], wide[..., 2:-2]
    dx = (8 * (x[..., 3:-1] - x[..., 1:-3]) - (x[..., 4:] - x[..., :-4])) / 12
    dy = (8 * (y[..., 3:-1, :] - y[..., 1:-3, :]) - (y[..., 4:, :] - y[..., :-4, :])) / 12
    return torch.cat([dx, dy], 1)


def median3(field: Tensor) -> Tensor:
    """3x3 median of every channel, (B, C, H, W)."""
    wide = F.pad(field, (1, 1, 1, 1), "replicate")
    return wide.unfold(2, 3, 1).unfold(3, 3, 1).flatten(-2).median(-1).values
