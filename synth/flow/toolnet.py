"""Instrument segmentation: a small U-Net (Ronneberger et al., MICCAI 2015) on a downsampled frame.

`evidence.flow.toolnet_training` trains its weights on rendered scenes. They are stored next to this file,
with a card that lists the command and the scores on held-out scenes.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from synth.arrays import Map, Pixels
from synth.system import checked_file

WEIGHTS = Path(__file__).with_name("toolnet.pt")
SIDE = 160  # px, longer side of the input
_STEP = 16  # px: both sides of the input are padded to multiples of it
_WIDTHS = (12, 24, 48, 64)


class ToolNet(nn.Module):
    """U-Net from RGB to one logit per pixel at half the size: (B, 3, H, W) → (B, 1, H/2, W/2)."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = _WIDTHS
        self.stem = _block(3, a, stride=2)
        self.down = nn.ModuleList([_block(a, b, 2), _block(b, c, 2), _block(c, d, 2)])
        self.up = nn.ModuleList([_block(d + c, c), _block(c + b, b), _block(b + a, a)])
        self.head = nn.Conv2d(a, 1, 1)

    def forward(self, picture: Tensor) -> Tensor:
        skips = [self.stem(picture)]
        for layer in self.down:
            skips.append(layer(skips[-1]))
        field = skips.pop()
        for layer in self.up:
            skip = skips.pop()
            field = F.interpolate(field, size=skip.shape[-2:], mode="bilinear", align_corners=False)
            field = layer(torch.cat([field, skip], 1))
        logits: Tensor = self.head(field)
        return logits


def prepare(rgb: Pixels) -> Map:
    """Network input (3, h, w) float32 of (H, W, 3) uint8: longer side 160 px, mean 0, deviation 1."""
    height, width = rgb.shape[:2]
    share = SIDE / max(height, width)
    size = (max(1, round(width * share)), max(1, round(height * share)))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    small = (small - small.mean()) / (small.std() + 8.0)
    spare = ((0, -small.shape[0] % _STEP), (0, -small.shape[1] % _STEP), (0, 0))
    return np.ascontiguousarray(np.pad(small, spare, "edge").transpose(2, 0, 1), np.float32)


@cache
def load() -> ToolNet:
    """The network with its weights."""
    net = ToolNet()
    net.load_state_dict(checked_file.read_tensors(WEIGHTS))  # half precision, widened
    return net.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def probability(net: ToolNet, rgb: Pixels) -> Map:
    """Probability (H, W) float32 that a pixel of `rgb` (H, W, 3) uint8 shows an instrument."""
    height, width = rgb.shape[:2]
    share = SIDE / max(height, width)
    with torch.inference_mode():
        logits = net(torch.from_numpy(prepare(rgb))[None].contiguous(memory_format=torch.channels_last))
        wide = F.interpolate(logits, scale_factor=2, mode="bilinear", align_corners=False)
        found = torch.sigmoid(wide)[0, 0, : max(1, round(height * share)), : max(1, round(width * share))]
    return np.asarray(cv2.resize(found.numpy(), (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _block(inside: int, outside: int, stride: int = 1) -> nn.Sequential:
    # A stride of 2 needs an even kernel: a kernel of 3 would shift the picture by half a pixel.
    return nn.Sequential(
        nn.Conv2d(inside, outside, 2 + stride, stride, 1, bias=False),
        nn.BatchNorm2d(outside),
        nn.ReLU(inplace=True),
        nn.Conv2d(outside, outside, 3, 1, 1, bias=False),
        nn.BatchNorm2d(outside),
        nn.ReLU(inplace=True),
    )
