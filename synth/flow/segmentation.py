"""Segmentation of what is not tissue: instruments and other objects in front of it, shadows and highlights.

A U-Net (O. Ronneberger et al., MICCAI 2015) takes a frame together with the rest frame, so that it sees what
appeared, and returns a probability per class and pixel. It was trained on domain-randomised renders and on
instruments, shadows and objects drawn over other pictures (D. Dwibedi et al., "Cut, paste and learn", ICCV
2017); `python -m evidence weights` trains such a network, the card next to the weights says from what.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from synth.arrays import Map, Mask, Pixels
from synth.flow.tvl1 import one_thread
from synth.system import checked_file

WEIGHTS = Path(__file__).with_name("segmentation.pt")
CLASSES = "instrument", "shadow", "highlight"
SIDE = 256  # px, longest side of the pictures in which classes are predicted: what it learnt is of one scale
_BLOCK = 4  # px: the finest level holds blocks of as many pixels in its channels
_MULTIPLE = 8 * _BLOCK  # px: the levels of the network need multiples of it on both sides
_WIDTHS = 32, 48, 80, 104
_FOUND = 0.5  # probability above which a class is taken to be there
_HIDING = 0.9  # and above which an instrument is taken to hide tissue, whose motion would be lost (design.md)


class SegmentationNet(nn.Module):
    """U-Net from a frame and the rest frame (B, 6, H, W) to logits (B, 3, H, W) of `CLASSES`."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = _WIDTHS
        self.stem = nn.Sequential(_layer(6 * _BLOCK**2, a, 1), _layer(a, a))
        self.down = nn.ModuleList([_block(a, b), _block(b, c), _block(c, d)])
        self.whole = nn.Linear(d, d)
        self.up = nn.ModuleList([_join(d + c, c), _join(c + b, b), _join(b + a, a)])
        self.head = nn.Conv2d(a, len(CLASSES) * _BLOCK**2, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        skips = [self.stem(F.pixel_unshuffle(pictures, _BLOCK))]
        for layer in self.down:
            skips.append(layer(skips[-1]))
        field = skips.pop()
        field = field + self.whole(field.mean((2, 3)))[..., None, None]  # colours of the whole picture
        for layer in self.up:
            field = layer(torch.cat([_doubled(field), skips.pop()], 1))
        return F.pixel_shuffle(self.head(field), _BLOCK)


class _Residual(nn.Module):
    """Two convolutions whose result is added to what they were given (K. He et al., CVPR 2016)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _layer(width, width)
        self.second = nn.Sequential(nn.Conv2d(width, width, 3, padding=1, bias=False), nn.BatchNorm2d(width))

    def forward(self, field: Tensor) -> Tensor:
        return F.relu(field + self.second(self.first(field)))


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Probabilities (H, W) float32 in 0..1 of each class in a frame."""

    instrument: Map  # or another object in front of the tissue
    shadow: Map  # of an instrument
    highlight: Map

    @property
    def objects(self) -> Mask:
        """(H, W) instruments and other objects."""
        return np.asarray(self.instrument > _FOUND)

    @property
    def hidden(self) -> Mask:
        """(H, W) where an object or a highlight hides the tissue, and a pixel around."""
        return _grown((self.instrument > _HIDING) | (self.highlight > _FOUND))

    @property
    def shines(self) -> Mask:
        """(H, W) highlights and a pixel around."""
        return _grown(self.highlight > _FOUND)


def segment(rest: Pixels, frame: Pixels) -> Segmentation:
    """The classes of a frame (H, W, 3) uint8, given the rest frame of the same size."""
    height, width = frame.shape[:2]
    share = SIDE / max(height, width)
    size = max(1, round(width * share)), max(1, round(height * share))
    mode = cv2.INTER_AREA if share < 1 else cv2.INTER_CUBIC
    small = [cv2.resize(one, size, interpolation=mode) for one in (frame, rest)]
    with torch.inference_mode(), one_thread():
        found = torch.sigmoid(load(WEIGHTS)(prepare(*small)))[0, :, : size[1], : size[0]].numpy()
    return Segmentation(*(cv2.resize(plane, (width, height)) for plane in found))


def with_highlights(video: Pixels, tools: Mask) -> Mask:
    """Masks (T, H, W) of a video (T, H, W, 3) from its rest frame on: given instruments, found highlights."""
    found = np.stack([segment(video[0], picture).shines for picture in video])
    return np.asarray(tools | found, bool)


def prepare(frame: Pixels, rest: Pixels) -> Tensor:
    """Input (1, 6, H', W') of the network: each picture (H, W, 3) with mean 0 and deviation 1, padded."""
    height, width = frame.shape[:2]
    spare = 0, -height % _MULTIPLE, 0, -width % _MULTIPLE
    pictures = []
    for picture in (frame, rest):
        mean, deviation = cv2.meanStdDev(picture)
        scale = 1 / (np.sqrt((deviation**2).mean() + mean.var()) + 8.0)
        wide = torch.from_numpy(cv2.copyMakeBorder(picture, *spare, cv2.BORDER_REPLICATE))
        pictures.append((wide.float() - float(mean.mean())) * float(scale))
    return torch.cat(pictures, -1).permute(2, 0, 1)[None]  # channels last in memory, as convolutions want it


@cache
def load(path: Path) -> SegmentationNet:
    """The network with its weights."""
    net = SegmentationNet()
    net.load_state_dict(checked_file.read_tensors(path))  # half precision, widened
    return net.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def _grown(mask: Mask) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _doubled(field: Tensor) -> Tensor:
    return F.interpolate(field, scale_factor=2.0, mode="bilinear", align_corners=False)


def _layer(inside: int, outside: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inside, outside, size, stride, (size - stride + 1) // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outside), nn.ReLU(inplace=True))


def _block(inside: int, outside: int) -> nn.Sequential:
    # A stride of 2 needs an even kernel: a kernel of 3 would shift the picture by half a pixel.
    return nn.Sequential(_layer(inside, outside, 4, 2), _Residual(outside))


def _join(inside: int, outside: int) -> nn.Sequential:
    return nn.Sequential(_layer(inside, outside, 1), _layer(outside, outside))
