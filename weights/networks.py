"""Networks of recovered motion as PyTorch trains them; `synth.flow` runs their ONNX files.

`SegmentationNet` is described in `synth.flow.segmentation`, `CorrectionNet` in `synth.flow.correction`; the
latter corrects depth too (`synth.flow.stereo.depth_correction`).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from evidence import report
from synth.flow import correction, segmentation

_BLOCK = 4  # px: the finest level of the segmentation holds blocks of as many pixels in its channels
_SEGMENTATION = 32, 48, 80, 104  # channels of the levels
_CORRECTION = 20, 32, 48


class SegmentationNet(nn.Module):
    """U-Net from a frame and the rest frame (B, 6, H, W) to logits (B, 3, H, W) of `segmentation.CLASSES`."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = _SEGMENTATION
        self.stem = nn.Sequential(_layer(segmentation.CHANNELS * _BLOCK**2, a, 1), _layer(a, a))
        self.down = nn.ModuleList([_downsample(a, b), _downsample(b, c), _downsample(c, d)])
        self.whole = nn.Linear(d, d)
        self.up = nn.ModuleList([_join(d + c, c), _join(c + b, b), _join(b + a, a)])
        self.head = nn.Conv2d(a, len(segmentation.CLASSES) * _BLOCK**2, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        skips = [self.stem(F.pixel_unshuffle(pictures, _BLOCK))]
        for layer in self.down:
            skips.append(layer(skips[-1]))
        field = skips.pop()
        field = field + self.whole(field.mean((2, 3)))[..., None, None]  # colours of the whole picture
        for layer in self.up:
            field = layer(torch.cat([_upsample(field), skips.pop()], 1))
        return F.pixel_shuffle(self.head(field), _BLOCK)


class CorrectionNet(nn.Module):
    """U-Net from features (B, channels, h, w) to corrections and their log-variances (B, 2 parts, h, w)."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, channels: int = correction.CHANNELS, parts: int = 2) -> None:
        super().__init__()
        a, b, c = _CORRECTION
        self.parts = parts
        self.register_buffer("mean", torch.zeros(1, channels, 1, 1))
        self.register_buffer("deviation", torch.ones(1, channels, 1, 1))
        self.stem = nn.Sequential(nn.Conv2d(channels, a, 1), nn.ReLU(), nn.Conv2d(a, a, 3, 1, 1), nn.ReLU())
        self.down = nn.ModuleList([_block(a, b, 2), _block(b, c, 2), _block(c, c, 2)])
        self.up = nn.ModuleList([_block(c + c, c), _block(c + b, b), _block(b + a, a)])
        self.head = nn.Conv2d(a, 2 * parts, 1)
        self.straight = nn.Conv2d(channels, parts, 1, bias=False)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.straight.weight)

    def forward(self, features: Tensor) -> Tensor:
        skips = [self.stem((features - self.mean) / self.deviation)]
        for layer in self.down:
            skips.append(layer(skips[-1]))
        field = skips.pop()
        for layer in self.up:
            field = layer(torch.cat([_upsample(field), skips.pop()], 1))
        residual, log_variance = self.head(field).split(self.parts, 1)
        return torch.cat([residual + self.straight(features), log_variance], 1)


def write_onnx(net: nn.Module, file: Path, channels: int) -> None:
    """Writes a network of `channels` inputs as ONNX, for pictures of any size, its weights at half precision.

    ONNX Runtime widens them once, when it reads the file. Needs the extra `export`.
    """
    import onnx

    sides = {2: "height", 3: "width"}
    with warnings.catch_warnings(action="ignore"):  # of the exporter that keeps the names of weights
        torch.onnx.export(
            net.cpu().eval(), (torch.zeros(1, channels, 64, 64),), str(file), dynamo=False, opset_version=17,
            input_names=["planes"], output_names=["found"], dynamic_axes={"planes": sides, "found": sides},
            do_constant_folding=False, training=torch.onnx.TrainingMode.PRESERVE,
        )  # fmt: skip
    model = onnx.load(file)
    weights = [tensor for tensor in model.graph.initializer if tensor.data_type == onnx.TensorProto.FLOAT]
    for weight in weights:
        values, name = onnx.numpy_helper.to_array(weight).astype(np.float16), weight.name
        weight.CopyFrom(onnx.numpy_helper.from_array(values, f"{name} half"))
        cast = onnx.helper.make_node("Cast", [f"{name} half"], [name], to=onnx.TensorProto.FLOAT)
        model.graph.node.insert(0, cast)
    onnx.save(model, file)


def read_onnx(net: nn.Module, file: Path) -> None:
    """Gives a network the weights of an ONNX file that `write_onnx` wrote of one like it."""
    import onnx

    halves = onnx.load(file).graph.initializer
    values = {half.name.removesuffix(" half"): onnx.numpy_helper.to_array(half) for half in halves}
    state = net.state_dict()
    # Counts of batches, which only training uses, aren't in the file.
    net.load_state_dict(
        state | {name: torch.from_numpy(value.astype(np.float32)) for name, value in values.items()}
    )


def export(net: nn.Module, file: Path, card: Mapping[str, Any], channels: int) -> None:
    """Writes a network with its number of inputs as ONNX, and next to it its card."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_onnx(net, file, channels)
    card = {**card, "parameters": sum(p.numel() for p in net.parameters()), "torch": torch.__version__}
    report.save(file.parent, f"{file.stem}.json", card)
    print(card)


def follow(average: nn.Module, net: nn.Module, share: float) -> None:
    """Moves the mean of weights and of batch statistics by a share towards those of a network."""
    with torch.no_grad():
        for mean, now in zip(average.state_dict().values(), net.state_dict().values(), strict=True):
            if mean.is_floating_point():
                mean.lerp_(now, share)


class _Residual(nn.Module):
    """Two convolutions whose result is added to what they were given (K. He et al., CVPR 2016)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _layer(width, width)
        self.second = nn.Sequential(nn.Conv2d(width, width, 3, padding=1, bias=False), nn.BatchNorm2d(width))

    def forward(self, field: Tensor) -> Tensor:
        return F.relu(field + self.second(self.first(field)))


def _upsample(field: Tensor) -> Tensor:
    return F.interpolate(field, scale_factor=2.0, mode="bilinear", align_corners=False)


def _layer(inside: int, outside: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inside, outside, size, stride, (size - stride + 1) // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outside), nn.ReLU(inplace=True))


def _downsample(inside: int, outside: int) -> nn.Sequential:
    # A stride of 2 needs an even kernel: a kernel of 3 would shift the picture by half a pixel.
    return nn.Sequential(_layer(inside, outside, 4, 2), _Residual(outside))


def _join(inside: int, outside: int) -> nn.Sequential:
    return nn.Sequential(_layer(inside, outside, 1), _layer(outside, outside))


def _block(inside: int, outside: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inside, outside, 2 + stride, stride, 1),
        nn.ReLU(inplace=True),
        nn.Conv2d(outside, outside, 3, 1, 1),
        nn.ReLU(inplace=True),
    )
