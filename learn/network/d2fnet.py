"""D2FNet of Heraoui et al., from displacement to force map, in any width, depth and input size.

    x ─ stem ─ Block ─┬─ ½ ─ Block ─┬─ ½ ─ … ─ ½ ─ Block ─ Pyramid
                      │             └──────── … ─ ×2 ─ ⊕ ─ Block ─┐
                      └───────────────────────────────────── ×2 ─ ⊕ ─ Block ─ Heads ─ y

A Block is two convolutions and an attention gate (where × which channel), so each skip is gated before it is
concatenated; the pyramid pools 1/2/4/8 at the bottom; three bounded heads (low, middle, high force) are mixed
by soft weights. Width 32 on 256² is the paper's network: 13.1 M parameters, 27.7 GFLOP.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learn.network.shape import Architecture

# In units of the training data's 99.9th percentiles.
BOUNDS = (0.25, 0.75, 1.5)  # largest output of each head; 1.5 times the published ones, as a reserve
SMALL_CONTACTS = 4.0  # factor on them if `relative`: a contact half as wide moves the tissue half as far
LEAST_MOTION = 0.01  # that `relative` divides by, some 0.02 mm: noise is smaller


class D2FNet(nn.Module):
    """(B, C of `arch.channels`, N, N) → (B, 1|3, N, N) force map in units of `Scales.target`."""

    def __init__(self, arch: Architecture) -> None:
        super().__init__()
        self.arch = arch
        inputs, w = len(arch.channels), [arch.width * 2**level for level in range(arch.levels + 1)]
        self.stem: nn.Module = nn.Identity()
        if arch.stem > 1:
            self.stem = nn.Conv2d(inputs, w[0], 2 * arch.stem, stride=arch.stem, padding=arch.stem // 2)
            inputs = w[0]
        self.down = nn.ModuleList(Block(a, b, arch.dropout) for a, b in pairwise([inputs, *w[:-1]]))
        self.bottom = Block(w[-2], w[-1], arch.dropout)
        self.pyramid = Pyramid(w[-1])
        self.up = nn.ModuleList(nn.ConvTranspose2d(a, b, 2, stride=2) for a, b in pairwise(w[::-1]))
        self.merge = nn.ModuleList(Block(2 * b, b, arch.dropout) for b in w[-2::-1])
        reach = SMALL_CONTACTS if arch.relative else 1.0
        self.heads = Heads(w[0], arch.components, [reach * bound for bound in BOUNDS])
        self.apply(_he_initialise)
        self.heads.begin_small()

    def forward(self, x: Tensor) -> Tensor:
        mask = x[:, 3:4]
        if self.arch.relative:
            largest = self.largest_motion(x)
            x = self.per_motion(x, largest)
        h = self.stem(x)
        skips = []
        for block in self.down:
            skips.append(block(h))
            h = F.max_pool2d(skips[-1], 2)
        h = self.pyramid(self.bottom(h))
        for rise, block, skip in zip(self.up, self.merge, reversed(skips), strict=True):
            h = block(torch.cat([rise(h), skip], dim=1))
        y: Tensor = self.heads(h)
        if self.arch.stem > 1:
            y = F.interpolate(y, scale_factor=float(self.arch.stem), mode="bilinear", align_corners=False)
        y = y * mask
        return y * largest if self.arch.relative else y

    def largest_motion(self, x: Tensor) -> Tensor:
        """The largest mean displacement of 3 × 3 cells, (B, 1, 1, 1) in the channels' unit."""
        size = x[:, self.arch.axes].square().sum(1, keepdim=True)
        peak = F.avg_pool2d(size, 3, 1, 1).flatten(1).amax(1)
        return (peak + LEAST_MOTION**2).sqrt()[:, None, None, None]

    def per_motion(self, x: Tensor, largest: Tensor) -> Tensor:
        """The channels with those of motion divided by the largest."""
        plain = [name.startswith(("mask", "confidence", "membrane")) for name in self.arch.channels]
        return torch.where(x.new_tensor(plain)[None, :, None, None] > 0, x, x / largest)


class Block(nn.Module):
    """Two 3×3 convolutions with batch norm, then the gate and dropout of whole channels."""

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


class Gate(nn.Module):
    """Spatial attention times channel attention."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = channels // 4
        self.place = nn.Sequential(nn.Conv2d(channels, inner, 1), nn.ReLU(), nn.Conv2d(inner, 1, 1))
        self.channel = nn.Sequential(nn.Conv2d(channels, inner, 1), nn.ReLU(), nn.Conv2d(inner, channels, 1))

    def forward(self, x: Tensor) -> Tensor:
        mean = x.mean(dim=(2, 3), keepdim=True)
        return x * torch.sigmoid(self.place(x)) * torch.sigmoid(self.channel(mean))


class Pyramid(nn.Module):
    """Pyramid pooling over 1, 4, 16 and 64 parts of the picture (Zhao et al. 2017)."""

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
    """Three bounded maps from the same features, mixed in every pixel by softmax weights.

    A magnitude is a sigmoid times its bound, a component a tanh times its bound.
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
        maps = [squash(head(x)) * bound for head, bound in zip(self.ranges, self.bounds, strict=True)]
        weights = torch.softmax(self.mix(torch.cat(maps, dim=1)), dim=1)
        low, middle, high = (level * weights[:, i : i + 1] for i, level in enumerate(maps))
        return low + middle + high

    def begin_small(self) -> None:
        """Initialises the heads near zero force: half a bound everywhere would be a large false positive.

        A bias of -2 gives a tenth of a bound; at -4 the sigmoids would be too flat to learn.
        """
        for conv in self.ranges:
            nn.init.normal_(conv.weight, std=0.02)  # type: ignore[arg-type]
            nn.init.constant_(conv.bias, 0.0 if self.signed else -2.0)  # type: ignore[arg-type]


def _he_initialise(module: nn.Module) -> None:
    """He initialisation (fan out), as deep ReLU networks need it."""
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        assert module.bias is not None
        nn.init.zeros_(module.bias)
