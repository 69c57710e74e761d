"""D2FNet, from displacement to force map, as Heraoui et al. draw it, in any width, depth and input size.

Encoder-decoder of double convolutions; the features of every block pass an attention gate (where × which
channel), so each skip is gated before it is concatenated; pyramid pooling 1/2/4/8 at the bottom; three
bounded heads (low, middle, high force) fused by soft weights. Width 32 on 256² is the paper's network:
13.1 M parameters, 27.7 GFLOP.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from synth.job.types import Section


class Architecture(Section):
    """Everything that decides the network's shape; stored in the checkpoint."""

    width: Annotated[int, Field(ge=4, le=512, multiple_of=4)] = 32
    """Channels of the first level; each level doubles them."""
    levels: Annotated[int, Field(ge=1, le=5)] = 4
    """Times the picture is halved after the stem."""
    stem: Annotated[int, Field(ge=1, le=4)] = 1
    """Stride of the first convolution; 4 makes the network live (`d2fnet-s`)."""
    output: Literal["magnitude", "vector"] = "vector"
    """`magnitude`: force density ≥ 0; `vector`: its x, y, z in camera axes."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    confidence: bool = False
    """Whether a sixth channel holds the flow's confidence."""
    depth: bool = False
    """Whether it is told motion along the view too, from a second eye: `input` motion; with confidence its
    confidence as well."""
    relative: bool = False
    """Whether it is told displacement as a share of the frame's largest, and its answer multiplied by that:
    twice the motion is then twice the force, as in linear elasticity, and need not be learnt."""

    @model_validator(mode="after")
    def _stem_is_possible(self) -> Architecture:
        if self.stem == 3:
            raise ValueError("a stem is 1, 2 or 4")
        return self

    @property
    def inputs(self) -> int:
        """Channels that it is told."""
        return 5 + self.confidence + self.depth * (1 + self.confidence)

    @property
    def displacements(self) -> int:
        """Components of the displacement that it is told."""
        return 3 if self.depth else 2

    @property
    def components(self) -> int:
        return 1 if self.output == "magnitude" else 3


class Gate(nn.Module):
    """Attention over place times attention over channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = max(channels // 4, 1)
        self.place = nn.Sequential(nn.Conv2d(channels, inner, 1), nn.ReLU(), nn.Conv2d(inner, 1, 1))
        self.channel = nn.Sequential(nn.Conv2d(channels, inner, 1), nn.ReLU(), nn.Conv2d(inner, channels, 1))

    def forward(self, x: Tensor) -> Tensor:
        mean = x.mean(dim=(2, 3), keepdim=True)
        return x * torch.sigmoid(self.place(x)) * torch.sigmoid(self.channel(mean))


class Block(nn.Module):
    """Two 3×3 convolutions with batch norm, the gate and dropout of whole channels."""

    def __init__(self, inputs: int, outputs: int, dropout: float) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(inputs, outputs, 3, padding=1),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
            nn.Conv2d(outputs, outputs, 3, padding=1),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
            Gate(outputs),
            nn.Dropout2d(dropout),
        )

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.body(x)
        return y


class Pyramid(nn.Module):
    """Context of the whole picture, its quarters, sixteenths and sixty-fourths (Zhao et al. 2017)."""

    BINS = (1, 2, 4, 8)

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.squeeze = nn.ModuleList(nn.Conv2d(channels, channels // 4, 1) for _ in self.BINS)
        self.join = nn.Conv2d(2 * channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        size = x.shape[2]
        parts = [x]
        for bins, conv in zip(self.BINS, self.squeeze, strict=True):
            small = F.avg_pool2d(x, size // bins) if size >= bins else x
            parts.append(F.interpolate(conv(small), size=(size, size), mode="bilinear", align_corners=False))
        y: Tensor = self.join(torch.cat(parts, dim=1))
        return y


class Heads(nn.Module):
    """Three bounded readings of the same features, mixed a pixel at a time by soft weights.

    A magnitude is a sigmoid times its bound; a component has a sign and is a tanh times its bound.
    """

    def __init__(self, inputs: int, components: int, bounds: Sequence[float]) -> None:
        super().__init__()
        self.signed = components > 1
        inner = max(inputs // 2, 4)
        self.features = nn.Conv2d(inputs, inner, 3, padding=1)
        self.ranges = nn.ModuleList(nn.Conv2d(inner, components, 1) for _ in bounds)
        self.mix = nn.Sequential(
            nn.Conv2d(3 * components, 8, 3, padding=1), nn.ReLU(), nn.Conv2d(8, 3, 3, padding=1)
        )
        self.bounds = bounds

    def forward(self, x: Tensor) -> Tensor:
        x = self.features(x)
        squash = torch.tanh if self.signed else torch.sigmoid
        readings = [squash(head(x)) * bound for head, bound in zip(self.ranges, self.bounds, strict=True)]
        weights = torch.softmax(self.mix(torch.cat(readings, dim=1)), dim=1)
        return sum((r * weights[:, i : i + 1] for i, r in enumerate(readings)), torch.zeros_like(readings[0]))


class D2FNet(nn.Module):
    """(B, `arch.inputs`, N, N) → (B, 1|3, N, N) force map in units of `Scales.target`, 0 outside the mask."""

    linear: Tensor

    def __init__(self, arch: Architecture) -> None:
        super().__init__()
        self.arch = arch
        widths = [arch.width * 2**i for i in range(arch.levels + 1)]
        self.register_buffer("linear", _linear(arch), persistent=False)
        first = arch.inputs
        self.stem: nn.Module = nn.Identity()
        if arch.stem > 1:
            s, first = arch.stem, arch.width
            self.stem = nn.Conv2d(arch.inputs, arch.width, 2 * s, stride=s, padding=s // 2)
        self.down = nn.ModuleList(
            Block(a, b, arch.dropout) for a, b in zip([first, *widths[:-2]], widths[:-1], strict=True)
        )
        self.bottom = Block(widths[-2], widths[-1], arch.dropout)
        self.pyramid = Pyramid(widths[-1])
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(a, b, 2, stride=2) for a, b in zip(widths[:0:-1], widths[-2::-1], strict=True)
        )
        self.merge = nn.ModuleList(Block(2 * b, b, arch.dropout) for b in widths[-2::-1])
        more = SMALL_CONTACTS if arch.relative else 1.0
        self.heads = Heads(arch.width, arch.components, [bound * more for bound in BOUNDS])
        self.apply(_start)
        _start_small(self.heads)

    def forward(self, x: Tensor) -> Tensor:
        mask, largest = x[:, 3:4], None
        if self.arch.relative:
            largest = largest_motion(x, self.arch)
            x = torch.where(self.linear > 0, x / largest, x)
        h = self.stem(x)
        skips = []
        for block in self.down:
            h = block(h)
            skips.append(h)
            h = F.max_pool2d(h, 2)
        h = self.pyramid(self.bottom(h))
        for rise, block, skip in zip(self.up, self.merge, reversed(skips), strict=True):
            h = block(torch.cat([rise(h), skip], dim=1))
        y: Tensor = self.heads(h)
        if self.arch.stem > 1:
            y = F.interpolate(y, scale_factor=float(self.arch.stem), mode="bilinear", align_corners=False)
        y = y * mask
        return y if largest is None else y * largest


BOUNDS = (0.25, 0.75, 1.5)
"""Largest value each head can give, in units of the training data's 99.9th percentile. The paper's heads stop
at 1/6, 1/2 and 1 of the largest force it has; half as much again is kept in hand here."""
SMALL_CONTACTS = 4.0
"""By how much `relative` heads reach further: a contact half as wide moves the tissue half as far."""
LEAST_MOTION = 0.01
"""Of the training data's 99.9th percentile, some 0.02 mm: under it what moves is noise, and stays small."""


def largest_motion(x: Tensor, arch: Architecture) -> Tensor:
    """The frame's largest displacement, averaged over 3 × 3 cells, (B, 1, 1, 1), in the channels' unit."""
    along = 5 + arch.confidence
    motion = torch.cat([x[:, :2], x[:, along : along + 1]], dim=1) if arch.depth else x[:, :2]
    size = motion.square().sum(1, keepdim=True)
    peak = F.avg_pool2d(size, 3, 1, 1).flatten(1).amax(1)
    return (peak + LEAST_MOTION**2).sqrt()[:, None, None, None]


def _linear(arch: Architecture) -> Tensor:
    """(1, C, 1, 1): 1 for channels in proportion to displacement, 0 for masks and confidences."""
    found = torch.ones(arch.inputs)
    found[[3, *([5] if arch.confidence else []), *([7] if arch.confidence and arch.depth else [])]] = 0
    return found[None, :, None, None]


def _start(module: nn.Module) -> None:
    """He initialisation (fan out), as deep ReLU networks need it."""
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        if module.bias is not None:
            nn.init.zeros_(module.bias)


def _start_small(heads: Heads) -> None:
    """Begin near no force at all: half a bound everywhere would be one large ghost to unlearn.

    A bias of -2 is a tenth of a bound; at -4 the sigmoids are so flat that little force left at the start is
    also slow to go.
    """
    for conv in heads.ranges:
        assert isinstance(conv, nn.Conv2d)
        assert conv.bias is not None
        nn.init.normal_(conv.weight, std=0.02)
        nn.init.constant_(conv.bias, 0.0 if heads.signed else -2.0)


def fused(model: nn.Module) -> nn.Module:
    """A copy for evaluation in which every batch norm is folded into the convolution before it."""
    quick = copy.deepcopy(model).eval()
    for block in quick.modules():
        if isinstance(block, Block):
            for conv, norm in ((0, 1), (3, 4)):
                one, two = block.body[conv], block.body[norm]
                if isinstance(one, nn.Conv2d) and isinstance(two, nn.BatchNorm2d):
                    block.body[conv], block.body[norm] = fuse_conv_bn_eval(one, two), nn.Identity()
    return quick
