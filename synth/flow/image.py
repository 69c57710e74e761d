"""Image operations of the flow solver on batched torch tensors; masked pixels are excluded throughout.

Tensors are (B, C, H, W) float32 on the CPU; `usable` is (B, 1, H, W) float32 in 0..1.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from synth.arrays import Map, Mask, Pixels
from synth.flow import kernels

# Luminance from red, green and blue: vessels have most contrast in green, averaging reduces noise.
GREY = np.array([0.2, 0.6, 0.2], np.float32)
GREY_PER_DEVIATION = 32.0  # normalised contrast of +-4 local deviations spans 8 bits
_WINDOW = 6.5  # px, standard deviation of the window of `normalise`
_FLOOR = 3.0  # grey levels added to the local deviation, so that noise is not amplified to full contrast


def local_contrast(grey: Map, window: tuple[int, int]) -> Pixels:
    """Local contrast (H, W), centred at 128, of a picture (H, W) in grey levels: no gain, no offset."""
    detail = grey - cv2.blur(grey, window)
    # Rounding in the running sums of a blur can make the variance of a blank picture negative.
    spread = np.sqrt(np.maximum(cv2.blur(detail * detail, window), 0)) + _FLOOR
    return np.asarray(np.clip(128 + GREY_PER_DEVIATION * detail / spread, 0, 255), np.uint8)


@dataclass(frozen=True)
class Level:
    """One level of the pyramid: contrast-normalised pictures and their masks, each (B, 1, H, W)."""

    rest: Tensor
    now: Tensor
    rest_usable: Tensor
    now_usable: Tensor


def ends(flow: Map) -> tuple[Map, Map]:
    """Columns and rows, (H, W) px each, to which a flow (H, W, 2) px leads."""
    x, y = (np.arange(n, dtype=np.float32) for n in flow.shape[1::-1])
    return x + flow[..., 0], y[:, None] + flow[..., 1]


def tensor(picture: Pixels) -> Tensor:
    """Luminance of (H, W, 3) or (B, H, W, 3) uint8 RGB in grey levels: (B, 1, H, W)."""
    rgb = torch.from_numpy(np.ascontiguousarray(picture)).float()
    grey = rgb @ torch.from_numpy(GREY)
    return grey.reshape(-1, 1, *grey.shape[-2:])


def flags(mask: Mask | Map) -> Tensor:
    """(H, W) or (B, H, W) as (B, 1, H, W) float32."""
    wide = torch.from_numpy(np.ascontiguousarray(mask)).float()
    return wide.reshape(-1, 1, *wide.shape[-2:])


def box(field: Tensor, radius: int) -> Tensor:
    """Mean of (B, C, H, W) over squares of 2 radius + 1 pixels; over fewer at the border."""
    planes = field.contiguous().numpy().reshape(-1, *field.shape[-2:])
    out = np.empty_like(planes)
    kernels.box_into(planes, (0,) * (2 * radius + 1), out)
    return torch.from_numpy(out).view_as(field)


def halved(field: Tensor) -> Tensor:
    """Mean of (B, C, H, W) over 2 x 2 pixels: (B, C, ceil(H/2), ceil(W/2)); over fewer at an odd border."""
    *batch, height, width = field.shape
    planes = field.contiguous().numpy().reshape(-1, height, width)
    out = np.empty((len(planes), (height + 1) // 2, (width + 1) // 2), np.float32)
    kernels.halve_into(planes, out)
    return torch.from_numpy(out).view(*batch, *out.shape[1:])


def window(field: Tensor, sigma: float) -> Tensor:
    """Approximate Gaussian blur at half the size, (B, C, H/2, W/2): two box filters."""
    small = halved(field)
    radius = max(1, round(sigma / 2 * 1.5**0.5 - 0.5))  # each box has the variance ((2r+1)^2 - 1)/12
    return box(box(small, radius), radius)


def doubled(field: Tensor, like: Tensor) -> Tensor:
    """`field` (B, C, h, w) at twice its size (bilinear), cropped to the height and width of `like`."""
    planes, (height, width) = field.numpy().reshape(-1, *field.shape[-2:]), like.shape[-2:]
    size = 2 * planes.shape[2], 2 * planes.shape[1]
    found = np.stack([cv2.resize(plane, size)[:height, :width] for plane in planes])
    return torch.from_numpy(found).view(*field.shape[:2], height, width)


def normalise(grey: Tensor, usable: Tensor) -> Tensor:
    """Local contrast normalisation (I - mean) / (deviation + floor) of grey levels (B, 1, H, W) over usable
    neighbours only: local standard deviations, 0 at masked pixels.

    It removes gains and offsets that vary more slowly than the window, such as drifting illumination.
    """
    # Centring at 128 avoids cancellation in the difference of squares.
    centred = (grey - 128.0) * usable
    sums = window(torch.cat([usable, centred, (grey - 128.0) * centred], dim=1), _WINDOW)
    mean = sums[:, 1:] / sums[:, :1].clamp_min(1e-4)
    deviation = (mean[:, 1:] - mean[:, :1] ** 2).clamp_min(0).sqrt() + _FLOOR
    smooth = doubled(torch.cat([mean[:, :1] + 128.0, 1 / deviation], 1), grey)
    return (usable > 0) * (grey - smooth[:, :1]) * smooth[:, 1:]


def fill(field: Tensor, usable: Tensor) -> Tensor:
    """A field (B, C, H, W) whose masked pixels are filled from around; zeros if no pixel is usable.

    Push-pull (Gortler et al., The Lumigraph, 1996, sec. 3.5). Where `usable` is 1 the field stays as it is.
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
    """Samples of `now` (1, 1, H, W) at x + w (bicubic) for a flow w (1, 2, H, W) px, and the largest
    weight of the four pixels around: 0 where the interpolated weight is at most 0.9 of it, as at a masked
    pixel or the border."""
    out = np.empty((2, 1, 1, *now.shape[-2:]), np.float32)
    one, known, by = (field.contiguous().numpy() for field in (now[0, 0], usable[0, 0], flow[0]))
    kernels.warp_into(one, known, by, out[0, 0, 0], out[1, 0, 0])
    return torch.from_numpy(out[0]), torch.from_numpy(out[1])
