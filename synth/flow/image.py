"""Pictures as the solver reads them: batched torch tensors, every operation aware of what is masked.

Tensors are (B, C, H, W) float32; `usable` is (B, 1, H, W) float32 in 0..1. CPU and CUDA run the same code.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

_GREY = (0.2, 0.6, 0.2)  # vessels stand out in green, noise falls by averaging
_FLOOR = 3.0  # grey levels: contrast below this is noise and isn't stretched to full contrast


def tensor(picture: NDArray[np.uint8], device: str = "cpu") -> Tensor:
    """Luminance of (H, W, 3) or (B, H, W, 3) uint8 RGB in grey levels: (B, 1, H, W)."""
    rgb = torch.from_numpy(np.ascontiguousarray(picture)).to(device).float()
    grey = rgb @ torch.tensor(_GREY, device=device)
    return grey.reshape(-1, 1, *grey.shape[-2:])


def flags(mask: NDArray[np.bool_], device: str = "cpu") -> Tensor:
    """(H, W) or (B, H, W) bool as (B, 1, H, W)."""
    wide = torch.from_numpy(np.ascontiguousarray(mask)).to(device).float()
    return wide.reshape(-1, 1, *wide.shape[-2:])


def box(field: Tensor, radius: int) -> Tensor:
    """Mean over (2 radius + 1)², smaller at the border. Separable."""
    wide = 2 * radius + 1
    rows = F.avg_pool2d(field, (1, wide), 1, (0, radius), count_include_pad=False)
    return F.avg_pool2d(rows, (wide, 1), 1, (radius, 0), count_include_pad=False)


def gaussian(field: Tensor, sigma: float) -> Tensor:
    """Gaussian blur with replicated border, separable. Each channel by itself."""
    radius = max(1, int(3 * sigma + 0.5))
    at = torch.arange(-radius, radius + 1, device=field.device, dtype=field.dtype)
    kernel = torch.exp(-0.5 * (at / sigma) ** 2)
    kernel = kernel / kernel.sum()
    flat = field.reshape(-1, 1, *field.shape[-2:])
    flat = F.conv2d(F.pad(flat, (radius, radius, 0, 0), "replicate"), kernel.view(1, 1, 1, -1))
    flat = F.conv2d(F.pad(flat, (0, 0, radius, radius), "replicate"), kernel.view(1, 1, -1, 1))
    return flat.reshape(field.shape)


def normalise(grey: Tensor, usable: Tensor, radius: int = 8) -> Tensor:
    """Local contrast normalisation: (I - mean) / (deviation + floor) over the usable neighbours only.

    Takes out every gain and offset that varies slower than the window, hence illumination drift. Two box
    filters stand for a Gaussian window. Masked pixels get 0, the local mean.
    """
    # Statistics of I - 128: the difference of two squares loses fewer digits.
    centred = (grey - 128.0) * usable
    sums = torch.cat([usable, centred, centred * centred], dim=1)
    for _ in range(2):
        sums = box(sums, radius)
    mean = sums[:, 1:] / sums[:, :1].clamp_min(1e-4)
    deviation = (mean[:, 1:] - mean[:, :1] ** 2).clamp_min(0).sqrt()
    normalised: Tensor = usable * (grey - 128.0 - mean[:, :1]) / (deviation + _FLOOR)
    return normalised


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
    total = F.avg_pool2d(torch.cat([known, usable], 1), 2, ceil_mode=True, count_include_pad=False)
    weight = total[:, -1:]
    coarse = fill(total[:, :-1] / weight.clamp_min(1e-6), (weight > 0).to(field.dtype))
    back = F.interpolate(coarse, size=field.shape[-2:], mode="bilinear", align_corners=False)
    return known + (1 - usable) * back
