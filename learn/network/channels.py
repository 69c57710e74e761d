"""The network's input channels as tensors, and the turns and reflections of fields on the grid."""

from __future__ import annotations

import functools

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from learn.data.grid import SMOOTHING_MM, Scales


def channels(
    displacement: Tensor,
    mask: Tensor,
    pitch_mm: float,
    scales: Scales,
    confidence: Tensor | None = None,
    membrane: Tensor | None = None,
) -> Tensor:
    """The network's input, in the order of `Shape.channels`.

    `displacement`: (B, 2, N, N) mm in picture axes, or (B, 3, N, N) mm in camera axes; `mask`: (B, 1, N, N)
    0/1; `confidence`: (B, 1, N, N) in 0..1, with depth (B, 2, N, N); `membrane`: (B,) of `membrane_code`.
    Returns (B, 5 to 9, N, N), dimensionless.
    Source: the five channels of Heraoui et al., here in mm and with one displacement scale.
    """
    motion = displacement * mask / scales.displacement_mm
    # vector_norm takes ten times as long over so short an axis.
    length = (motion[:, :1].square() + motion[:, 1:2].square()).sqrt()
    parts = [motion[:, :2], length, mask, divergence(displacement, mask, pitch_mm) / scales.divergence]
    if confidence is not None:
        parts.append(confidence[:, :1] * mask)
    parts.append(motion[:, 2:])
    if confidence is not None:
        parts.append(confidence[:, 1:] * mask)
    if membrane is not None:
        parts.append(membrane[:, None, None, None] * mask)
    return torch.cat(parts, dim=1)


def rotate(values: Tensor, turn: int) -> Tensor:
    """Fields (B, C, N, N) turned by `turn` % 4 × 90° counter-clockwise, and mirrored first if `turn` ≥ 4; two
    or three channels begin with x, y components, a single one is a scalar."""
    vector = values.shape[1] > 1
    sign = values.new_tensor([-1.0, 1.0, 1.0][: values.shape[1]]).view(1, -1, 1, 1)
    if turn >= 4:
        values = values.flip(-1) * sign if vector else values.flip(-1)
    for _ in range(turn % 4):
        values = values.rot90(dims=(2, 3))
        if vector:
            values = torch.cat([values[:, 1:2], -values[:, :1], values[:, 2:]], dim=1)
    return values


def divergence(displacement: Tensor, mask: Tensor, pitch_mm: float) -> Tensor:
    """∂dx/∂x + ∂dy/∂y of the smoothed displacement, dimensionless, 0 outside the mask.

    Only masked cells are used (at the mask's edge the difference is one-sided), so that the edge causes no
    strain. `displacement`: (B, 2 or 3, N, N) mm, dz unused; `mask`: (B, 1, N, N) 0/1. Returns (B, 1, N, N).
    """
    sigma = SMOOTHING_MM / pitch_mm
    smooth = _smooth(displacement[:, :2] * mask, sigma) / _smooth(mask, sigma).clamp_min(1e-6)
    return (_difference(smooth[:, :1], mask, 3) + _difference(smooth[:, 1:2], mask, 2)) * mask / pitch_mm


def _difference(values: Tensor, mask: Tensor, dim: int) -> Tensor:
    """Mean of the forward and backward differences with both ends in the mask."""
    n = values.shape[dim]
    step = values.narrow(dim, 1, n - 1) - values.narrow(dim, 0, n - 1)
    pair_mask = mask.narrow(dim, 1, n - 1) * mask.narrow(dim, 0, n - 1)
    ahead, behind = ((0, 1), (1, 0)) if dim == 3 else ((0, 0, 0, 1), (0, 0, 1, 0))
    step = step * pair_mask
    count = F.pad(pair_mask, ahead) + F.pad(pair_mask, behind)
    return (F.pad(step, ahead) + F.pad(step, behind)) / count.clamp_min(1)


def _smooth(values: Tensor, sigma_px: float) -> Tensor:
    """Gaussian-smoothed planes (..., N, N), zero outside, by a matrix cut at 3 sigma, block by block.

    A depthwise convolution takes five times as long on a CPU, the whole matrix three times.
    """
    n, reach = values.shape[-1], _reach(sigma_px)
    band = _smoother(n, sigma_px).to(values)
    blocks = [
        (a, min(a + _BLOCK, n), max(a - reach, 0), min(a + _BLOCK + reach, n)) for a in range(0, n, _BLOCK)
    ]
    down = torch.cat([band[a:b, c:d] @ values[..., c:d, :] for a, b, c, d in blocks], dim=-2)
    return torch.cat([down[..., c:d] @ band[c:d, a:b] for a, b, c, d in blocks], dim=-1)


_BLOCK = 64


def _reach(sigma_px: float) -> int:
    return max(1, int(np.ceil(3 * sigma_px)))


@functools.lru_cache(maxsize=8)
def _smoother(size: int, sigma_px: float) -> Tensor:
    """(N, N) symmetric matrix S, so that S u S is the Gaussian-smoothed u."""
    offsets = (torch.arange(size)[:, None] - torch.arange(size)[None, :]).to(torch.float32)
    weight = torch.exp(-0.5 * (offsets / max(sigma_px, 1e-3)) ** 2)
    weight[offsets.abs() > _reach(sigma_px)] = 0
    return weight / weight[size // 2].sum()
