"""Pictures as the solver reads them: batched torch tensors, every operation aware of what is masked.

Tensors are (B, C, H, W) float32; `usable` is (B, 1, H, W) float32 in 0..1. CPU and CUDA run the same code.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from synth.flow import fused

GREY = np.array([0.2, 0.6, 0.2], np.float32)
"""Luminance from red, green, blue: vessels stand out in green, noise falls by averaging."""
GREY_PER_DEVIATION = 32.0
"""Normalised contrast of +-4 deviations spans 8 bits."""
_FLOOR = 3.0  # grey levels: contrast below this is noise and isn't stretched to full contrast


def local_contrast(grey: NDArray[np.float32], window: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W) of a picture (H, W) in grey levels, about 128: gain and offset of the light are taken out."""
    detail = grey - cv2.blur(grey, window)
    # A blur's running sums may end below 0 where a picture is blank.
    spread = np.sqrt(np.maximum(cv2.blur(detail * detail, window), 0)) + _FLOOR
    return np.asarray(np.clip(128 + GREY_PER_DEVIATION * detail / spread, 0, 255), np.uint8)


@dataclass(frozen=True)
class Level:
    """One level of the pyramid: contrast-normalised pictures and their masks, each (B, 1, H, W)."""

    rest: Tensor
    now: Tensor
    rest_usable: Tensor
    now_usable: Tensor


def tensor(picture: NDArray[np.uint8], device: str = "cpu") -> Tensor:
    """Luminance of (H, W, 3) or (B, H, W, 3) uint8 RGB in grey levels: (B, 1, H, W)."""
    rgb = torch.from_numpy(np.ascontiguousarray(picture)).to(device).float()
    grey = rgb @ torch.from_numpy(GREY).to(device)
    return grey.reshape(-1, 1, *grey.shape[-2:])


def flags(mask: NDArray[np.bool_], device: str = "cpu") -> Tensor:
    """(H, W) or (B, H, W) bool as (B, 1, H, W)."""
    wide = torch.from_numpy(np.ascontiguousarray(mask)).to(device).float()
    return wide.reshape(-1, 1, *wide.shape[-2:])


def box(field: Tensor, radius: int) -> Tensor:
    """Mean of (B, C, H, W) over squares of 2 radius + 1 pixels, smaller at the border. Separable."""
    if field.device.type == "cpu":
        planes = field.contiguous().numpy().reshape(-1, *field.shape[-2:])
        out = np.empty_like(planes)
        fused.box_into(planes, (0,) * (2 * radius + 1), out)
        return torch.from_numpy(out).view_as(field)
    wide = 2 * radius + 1
    rows = F.avg_pool2d(field, (1, wide), 1, (0, radius), count_include_pad=False)
    return F.avg_pool2d(rows, (wide, 1), 1, (radius, 0), count_include_pad=False)


def halved(field: Tensor) -> Tensor:
    """Mean of (B, C, H, W) over 2 x 2 pixels, fewer at an odd border: (B, C, ceil(H/2), ceil(W/2))."""
    if field.device.type != "cpu":
        return F.avg_pool2d(field, 2, ceil_mode=True, count_include_pad=False)
    *batch, height, width = field.shape
    planes = field.contiguous().numpy().reshape(-1, height, width)
    out = np.empty((len(planes), (height + 1) // 2, (width + 1) // 2), np.float32)
    fused.halve_into(planes, out)
    return torch.from_numpy(out).view(*batch, *out.shape[1:])


def window(field: Tensor, sigma: float) -> Tensor:
    """About a Gaussian blur at half the size, (B, C, H/2, W/2): for windows, whose shape matters little."""
    small = halved(field)
    radius = max(1, round(sigma / 2 * 1.5**0.5 - 0.5))  # two boxes of variance ((2r+1)^2 - 1)/12 each
    return box(box(small, radius), radius)


def doubled(field: Tensor, like: Tensor) -> Tensor:
    """`field` (B, C, h, w) at twice its size, cut to the height and width of `like`. Bilinear."""
    if field.device.type == "cpu":
        planes, (height, width) = field.numpy().reshape(-1, *field.shape[-2:]), like.shape[-2:]
        size = 2 * planes.shape[2], 2 * planes.shape[1]
        found = np.stack([cv2.resize(plane, size)[:height, :width] for plane in planes])
        return torch.from_numpy(found).view(*field.shape[:2], height, width)
    wide = F.interpolate(field, scale_factor=2, mode="bilinear", align_corners=False)
    return wide[..., : like.shape[-2], : like.shape[-1]]


def normalise(grey: Tensor, usable: Tensor, sigma: float = 6.5) -> Tensor:
    """Local contrast normalisation: (I - mean) / (deviation + floor) over the usable neighbours only.

    Takes out every gain and offset that varies slower than the window, hence illumination drift. Masked
    pixels get 0, the local mean.

    Args:
        grey: (B, 1, H, W), grey levels.
        usable: (B, 1, H, W) in 0..1.
        sigma: standard deviation of the window [px].

    Returns:
        (B, 1, H, W), in local standard deviations.
    """
    # Statistics of I - 128: the difference of two squares loses fewer digits.
    centred = (grey - 128.0) * usable
    sums = window(torch.cat([usable, centred, centred * centred], dim=1), sigma)
    mean = sums[:, 1:] / sums[:, :1].clamp_min(1e-4)
    deviation = (mean[:, 1:] - mean[:, :1] ** 2).clamp_min(0).sqrt() + _FLOOR
    smooth = doubled(torch.cat([mean[:, :1] + 128.0, 1 / deviation], 1), grey)
    return usable * (grey - smooth[:, :1]) * smooth[:, 1:]


def fill(field: Tensor, usable: Tensor) -> Tensor:
    """Masked pixels from around: push-pull over a pyramid (Gortler et al., The Lumigraph, 1996, sec. 3.5).

    Args:
        field: (B, C, H, W).
        usable: (B, 1, H, W) in 0..1; where 1 the field is kept as it is.

    Returns:
        (B, C, H, W); zeros where nothing at all is usable.
    """
    known = field * usable
    if min(field.shape[-2:]) <= 2:
        mean = known.mean((-2, -1), keepdim=True) / usable.mean((-2, -1), keepdim=True).clamp_min(1e-6)
        return known + (1 - usable) * mean
    total = halved(torch.cat([known, usable], 1))
    weight = total[:, -1:]
    coarse = fill(total[:, :-1] / weight.clamp_min(1e-6), (weight > 0).to(field.dtype))
    back = F.interpolate(coarse, size=field.shape[-2:], mode="bilinear", align_corners=False)
    return known + (1 - usable) * back


def warp(now: Tensor, usable: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
    """`now` at x + w by bicubic sampling, and 1 where all it is read from is usable and inside, else 0.

    Args:
        now: (B, C, H, W).
        usable: (B, 1, H, W) in 0..1.
        flow: w, (B, 2, H, W) px.
    """
    height, width = now.shape[-2:]
    if now.shape[:2] == (1, 1) and now.device.type == "cpu":
        out = np.empty((2, 1, 1, height, width), np.float32)
        one, known, by = (field.contiguous().numpy() for field in (now[0, 0], usable[0, 0], flow[0]))
        fused.warp_into(one, known, by, out[0, 0, 0], out[1, 0, 0])
        return torch.from_numpy(out[0]), torch.from_numpy(out[1])
    x = torch.arange(width, device=now.device, dtype=now.dtype)
    y = torch.arange(height, device=now.device, dtype=now.dtype)[:, None]
    at = torch.stack([(2 * (x + flow[:, 0]) + 1) / width - 1, (2 * (y + flow[:, 1]) + 1) / height - 1], -1)
    picture = F.grid_sample(now, at, mode="bicubic", padding_mode="border", align_corners=False)
    seen = F.grid_sample(usable, at, mode="bilinear", padding_mode="zeros", align_corners=False)
    return picture, (seen > 0.9).to(now.dtype)


def derivative(field: Tensor) -> Tensor:
    """d/dx of every channel, then d/dy of every channel: (B, 2C, H, W); fourth-order central differences."""
    wide = F.pad(field, (2, 2, 2, 2), "replicate")
    x, y = wide[..., 2:-2, :], wide[..., 2:-2]
    dx = (8 * (x[..., 3:-1] - x[..., 1:-3]) - (x[..., 4:] - x[..., :-4])) / 12
    dy = (8 * (y[..., 3:-1, :] - y[..., 1:-3, :]) - (y[..., 4:, :] - y[..., :-4, :])) / 12
    return torch.cat([dx, dy], 1)


def median3(field: Tensor) -> Tensor:
    """3x3 median of every channel, (B, C, H, W).

    Sorts the columns; the median is that of the largest low, the middle mid and the smallest high.
    """
    wide = F.pad(field, (1, 1, 1, 1), "replicate")
    a, b, c = wide[..., :-2, :], wide[..., 1:-1, :], wide[..., 2:, :]
    low, high = torch.minimum(a, b), torch.maximum(a, b)
    middle, high = torch.minimum(high, c), torch.maximum(high, c)
    low, middle = torch.minimum(low, middle), torch.maximum(low, middle)

    def sides(f: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return f[..., :-2], f[..., 1:-1], f[..., 2:]

    lows, (m0, m1, m2), highs = sides(low), sides(middle), sides(high)
    top = torch.maximum(torch.maximum(lows[0], lows[1]), lows[2])
    bottom = torch.minimum(torch.minimum(highs[0], highs[1]), highs[2])
    mid = torch.maximum(torch.minimum(m0, m1), torch.minimum(torch.maximum(m0, m1), m2))
    return torch.maximum(torch.minimum(top, mid), torch.minimum(torch.maximum(top, mid), bottom))
