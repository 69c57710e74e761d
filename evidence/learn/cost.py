"""What a network costs, counted rather than timed."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from learn.network.d2fnet import Architecture
from learn.network.monai_unet import build


def parameters(model: nn.Module) -> int:
    """Number of trained parameters."""
    return sum(p.numel() for p in model.parameters() if p.requires_grad)


def flops(arch: Architecture, size: int) -> float:
    """Floating-point operations (2 a multiply-add) of the convolutions for one N×N frame."""
    total = 0

    def count(module: nn.Module, _: tuple[Tensor, ...], out: Tensor) -> None:
        nonlocal total
        if isinstance(module, nn.ConvTranspose2d):
            taps = module.in_channels * math.prod(module.kernel_size) / math.prod(module.stride)
            total += int(2 * taps * out.numel())
        elif isinstance(module, nn.Conv2d):
            total += 2 * module.in_channels * math.prod(module.kernel_size) * out.numel()

    with torch.device("meta"):
        model = build(arch).eval()
        for m in model.modules():
            m.register_forward_hook(count)
        model(torch.zeros(1, arch.inputs, size, size), torch.zeros(1, 1))
    return float(total)
