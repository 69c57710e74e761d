"""D2FNet, from displacement to force map, as Heraoui et al. draw it, in any width, depth and input size.

Encoder-decoder of double convolutions; the features of every block pass an attention gate (where × which
channel), so each skip is gated before it is concatenated; pyramid pooling 1/2/4/8 at the bottom; three
bounded heads (low, middle, high force) fused by soft weights. Width 32 on 256² is the paper's network:
13.1 M parameters, 27.7 GFLOP.
"""

from __future__ import annotations

import copy
from typing import Annotated, Any, Literal

import torch
import torch.nn.functional as F
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from learn.network.half_space import HalfSpace
from synth.errors import UserError
from synth.job.types import Positive, Section


class Architecture(Section):
    """Everything that decides the network's shape; stored in the checkpoint."""

    name: Literal["d2fnet", "unet", "monai-unet"] = "d2fnet"
    width: Annotated[int, Field(ge=4, le=512, multiple_of=4)] = 32
    """Channels of the first level; each level doubles them."""
    levels: Annotated[int, Field(ge=1, le=5)] = 4
    """Times the picture is halved after the stem."""
    stem: Annotated[int, Field(ge=1, le=4)] = 1
    """Stride of the first convolution; 4 makes the network live (`d2fnet-s`)."""
    detail: bool = False
    """With a stem of 4: strides two and two, and what the first sees also reaches the answer by a skip of
    its own, so that a contact's rim is drawn at half the input's resolution, not a quarter."""
    output: Literal["magnitude", "vector"] = "vector"
    """`magnitude`: force density ≥ 0; `vector`: its x, y, z in camera axes."""
    bounds: tuple[Positive, Positive, Positive] = (0.25, 0.75, 1.5)
    """Largest value each head can give, in units of the training data's 99.9th percentile. The paper's
    heads stop at 1/6, 1/2 and 1 of the largest force it has; half as much again is kept in hand here."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    confidence: bool = False
    """Whether a sixth channel holds the flow's confidence."""
    depth: bool = False
    """Whether it is told motion along the view too, from a second eye: `input` motion; with confidence its
    confidence as well."""
    total: bool = False
    """Whether a further head reads the total force from the bottleneck, also what lies beyond the grid."""
    condition: Literal["none", "film"] = "none"
    """`film`: Young's modulus modulates the bottleneck (feature-wise affine; Perez et al. 2018)."""
    prior: Literal["none", "channel", "residual"] = "none"
    """`channel`: it is also told the tractions by which a half-space would move so; `residual`: and they are
    its answer before anything is learnt, which it scales and corrects. Of one eye those across the view."""
    window: Literal[1, 3, 5] = 1
    """Frames whose displacement it is told: the present one and those before it, never a later one. Before
    the first is the rest frame."""
    relative: bool = False
    """Whether it is told displacement as a share of the frame's largest, and its answer multiplied by that:
    twice the motion is then twice the force, as in linear elasticity, and need not be learnt."""

    @model_validator(mode="after")
    def _stem_is_possible(self) -> Architecture:
        if self.stem == 3:
            raise ValueError("a stem is 1, 2 or 4")
        if self.detail and (self.stem != 4 or self.name == "monai-unet"):
            raise ValueError("detail goes with a stem of 4")
        if self.prior != "none" and self.name == "monai-unet":
            raise ValueError("monai-unet has no prior")
        if self.relative and self.name == "monai-unet":
            raise ValueError("monai-unet isn't told relative displacement")
        return self

    @model_serializer(mode="wrap")
    def _as_before(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without what came later and isn't used, so that models are written as they always were."""
        tree: dict[str, Any] = plain(self)
        unused = {"depth": False, "prior": "none", "window": 1, "relative": False}
        return {key: value for key, value in tree.items() if key not in unused or value != unused[key]}

    @property
    def inputs(self) -> int:
        now = 5 + self.confidence + self.depth * (1 + self.confidence)
        return now + (self.window - 1) * self.displacements

    @property
    def displacements(self) -> int:
        """Components of the displacement that it is told."""
        return 3 if self.depth else 2

    @property
    def seen(self) -> int:
        """Channels of the first convolution: `inputs`, and the prior."""
        return self.inputs + self.displacements * (self.prior != "none")

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
    """Two 3×3 convolutions with batch norm, the gate (if wanted) and dropout of whole channels."""

    def __init__(self, inputs: int, outputs: int, dropout: float, gated: bool) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(inputs, outputs, 3, padding=1),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
            nn.Conv2d(outputs, outputs, 3, padding=1),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
            Gate(outputs) if gated else nn.Identity(),
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

    A magnitude is a sigmoid times its bound; a component, or a correction, has a sign and is a tanh times its
    bound.
    """

    def __init__(
        self, inputs: int, components: int, bounds: tuple[float, float, float], signed: bool
    ) -> None:
        super().__init__()
        self.signed = signed
        self.components = components
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


class Total(nn.Module):
    """Total force from the bottleneck's mean features: its components, or its size if there is one."""

    def __init__(self, channels: int, components: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Linear(channels, channels // 4), nn.ReLU(), nn.Linear(channels // 4, components)
        )
        self.signed = components > 1

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.body(x.mean(dim=(2, 3)))
        return y if self.signed else F.softplus(y)


class D2FNet(nn.Module):
    """(B, `arch.inputs`, N, N) → (B, 1|3, N, N) force map in units of `Scales.target`, 0 outside the mask.

    With `arch.total` a pair: the map and (B, 1|3) total force in units of `Scales.force`.
    """

    linear: Tensor

    def __init__(self, arch: Architecture) -> None:
        super().__init__()
        self.arch = arch
        full = arch.name == "d2fnet"
        widths = [arch.width * 2**i for i in range(arch.levels + 1)]
        first = arch.seen
        self.prior = HalfSpace() if arch.prior != "none" else None
        self.register_buffer("linear", _linear(arch), persistent=False)
        self.stem: nn.Module = nn.Identity()
        fine = arch.width // 2 if arch.detail else 0
        self.fine: nn.Module | None = None
        if arch.stem > 1:
            s = 2 if arch.detail else arch.stem
            self.stem = nn.Conv2d(fine or arch.seen, arch.width, 2 * s, stride=s, padding=s // 2)
            first = arch.width
        if fine:
            self.fine = nn.Sequential(nn.Conv2d(arch.seen, fine, 4, stride=2, padding=1), nn.ReLU())
            self.rise = nn.ConvTranspose2d(arch.width, fine, 2, stride=2)
            self.draw = Block(2 * fine, fine, 0.0, False)
        self.down = nn.ModuleList(
            Block(a, b, arch.dropout, full) for a, b in zip([first, *widths[:-2]], widths[:-1], strict=True)
        )
        self.bottom = Block(widths[-2], widths[-1], arch.dropout, full)
        self.pyramid = Pyramid(widths[-1]) if full else nn.Identity()
        self.total = Total(widths[-1], arch.components) if arch.total else None
        self.film = nn.Linear(1, 2 * widths[-1]) if arch.condition == "film" else None
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(a, b, 2, stride=2) for a, b in zip(widths[:0:-1], widths[-2::-1], strict=True)
        )
        self.merge = nn.ModuleList(Block(2 * b, b, arch.dropout, full) for b in widths[-2::-1])
        residual = arch.prior == "residual"
        low, middle, high = arch.bounds
        more = SMALL_CONTACTS if arch.relative else 1.0
        bounds = (low * more, middle * more, high * more)
        self.heads: nn.Module = (
            Heads(fine or arch.width, arch.components, bounds, arch.components > 1 or residual)
            if full
            else nn.Conv2d(fine or arch.width, arch.components, 1)
        )
        # Tissue that is held moves less than a half-space: by how much is soon learnt.
        self.stiffness = nn.Parameter(torch.ones(arch.displacements, 1, 1)) if residual else None
        self.apply(_start)
        _start_small(self.heads, 0.0 if residual else 0.02)
        if self.film is not None:
            nn.init.zeros_(self.film.weight)
            nn.init.zeros_(self.film.bias)

    def forward(self, x: Tensor, log_young: Tensor | None = None) -> Tensor | tuple[Tensor, Tensor]:
        """`log_young`: (B, 1) ln(E / 1 kPa), used only by a `film` network."""
        mask, physical = x[:, 3:4], None
        largest = None
        if self.arch.relative:
            largest = largest_motion(x, self.arch)
            x = torch.where(self.linear > 0, x / largest, x)
        if self.prior is not None:
            physical = self.prior(told_motion(x, self.arch), mask)
            x = torch.cat([x, physical], dim=1)
        seen = x if self.fine is None else self.fine(x)
        h = self.stem(seen)
        skips = []
        for block in self.down:
            h = block(h)
            skips.append(h)
            h = F.max_pool2d(h, 2)
        h = self.pyramid(self.bottom(h))
        if self.film is not None:
            if log_young is None:
                raise UserError("this model is conditioned on Young's modulus: give young_kpa")
            gain, shift = self.film(log_young)[..., None, None].chunk(2, dim=1)
            h = h * (1 + gain) + shift
        total = None if self.total is None else self.total(h)
        for rise, block, skip in zip(self.up, self.merge, reversed(skips), strict=True):
            h = block(torch.cat([rise(h), skip], dim=1))
        if self.fine is not None:
            h = self.draw(torch.cat([self.rise(h), seen], dim=1))
        y: Tensor = self.heads(h)
        if self.arch.stem > 1:
            times = 2.0 if self.fine is not None else float(self.arch.stem)
            y = F.interpolate(y, scale_factor=times, mode="bilinear", align_corners=False)
        if physical is not None and self.stiffness is not None:
            y = _corrected(physical * self.stiffness, y)
        y = y * mask
        if largest is not None:
            y, total = y * largest, None if total is None else total * largest[:, :, 0, 0]
        return y if total is None else (y, total)


SMALL_CONTACTS = 4.0
"""By how much `relative` heads reach further: a contact half as wide moves the tissue half as far."""
LEAST_MOTION = 0.01
"""Of the training data's 99.9th percentile, some 0.02 mm: under it what moves is noise, and stays small."""


def largest_motion(x: Tensor, arch: Architecture) -> Tensor:
    """The frame's largest displacement, averaged over 3 × 3 cells, (B, 1, 1, 1), in the channels' unit."""
    size = told_motion(x, arch).square().sum(1, keepdim=True)
    peak = F.avg_pool2d(size, 3, 1, 1).flatten(1).amax(1)
    return (peak + LEAST_MOTION**2).sqrt()[:, None, None, None]


def _linear(arch: Architecture) -> Tensor:
    """(1, C, 1, 1): 1 for channels in proportion to displacement, 0 for masks and confidences."""
    found = torch.ones(arch.inputs)
    found[[3, *([5] if arch.confidence else []), *([7] if arch.confidence and arch.depth else [])]] = 0
    return found[None, :, None, None]


def told_motion(x: Tensor, arch: Architecture) -> Tensor:
    """The displacement among a network's channels, (B, 2|3, N, N)."""
    along = 5 + arch.confidence
    return torch.cat([x[:, :2], x[:, along : along + 1]], dim=1) if arch.depth else x[:, :2]


def _corrected(physical: Tensor, correction: Tensor) -> Tensor:
    """The prior (B, 2|3, N, N) with what was learnt on top: components, or a magnitude ≥ 0."""
    if correction.shape[1] == 1:
        return (physical.square().sum(1, keepdim=True).sqrt() + correction).clamp_min(0)
    # One eye sees nothing along the view: there is nothing to correct.
    return F.pad(physical, (0, 0, 0, 0, 0, 3 - physical.shape[1])) + correction


def _start(module: nn.Module) -> None:
    """He initialisation (fan out), as deep ReLU networks need it."""
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        if module.bias is not None:
            nn.init.zeros_(module.bias)


def _start_small(heads: nn.Module, std: float) -> None:
    """Begin near no force at all: half a bound everywhere would be one large ghost to unlearn.

    A bias of -2 is a tenth of a bound; at -4 the sigmoids are so flat that little force left at the start is
    also slow to go. A correction (`std` 0) begins at none.
    """
    last = list(heads.ranges) if isinstance(heads, Heads) else [heads]
    unsigned = isinstance(heads, Heads) and not heads.signed
    for conv in last:
        if isinstance(conv, nn.Conv2d) and conv.bias is not None:
            nn.init.normal_(conv.weight, std=std)
            nn.init.constant_(conv.bias, -2.0 if unsigned else 0.0)


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
