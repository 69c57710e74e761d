"""MONAI's U-Net behind the same channels, mask and outputs: what a reader would take off the shelf
instead."""

from __future__ import annotations

import importlib
from typing import Any

from torch import Tensor, nn

from learn.network.d2fnet import Architecture, D2FNet
from synth.errors import UserError


class MonaiUNet(nn.Module):
    """(B, `arch.inputs`, N, N) → (B, 1|3, N, N) force map in units of `Scales.target`, 0 outside the mask.

    Residual U-Net of MONAI (Kerfoot et al. 2018) with `arch.levels` halvings of `arch.width` channels; no
    heads
    with bounds, no gates, no pyramid.
    """

    def __init__(self, arch: Architecture) -> None:
        super().__init__()
        if arch.stem != 1 or arch.total or arch.condition != "none":
            raise UserError("monai-unet has no stem, no total-force head and no conditioning")
        try:
            nets: Any = importlib.import_module("monai.networks.nets")
        except ImportError:
            raise UserError("monai-unet needs MONAI: pip install monai") from None
        self.arch = arch
        widths = tuple(arch.width * 2**i for i in range(arch.levels + 1))
        self.body: nn.Module = nets.UNet(
            2,
            arch.inputs,
            arch.components,
            widths,
            (2,) * arch.levels,
            num_res_units=2,
            dropout=arch.dropout,
        )

    def forward(self, x: Tensor, log_young: Tensor | None = None) -> Tensor:
        y: Tensor = self.body(x) * x[:, 3:4]
        return y


def build(arch: Architecture) -> nn.Module:
    """The untrained network that an architecture names."""
    return MonaiUNet(arch) if arch.name == "monai-unet" else D2FNet(arch)
