"""A model folder of an untrained network whose random weights predict non-zero forces."""

from pathlib import Path

import torch

from learn import checkpoint
from learn.checkpoint import ModelCard
from learn.data.grid import Scales
from learn.inference.convert import add_onnx
from learn.network.registry import build
from learn.settings import preset
from synth.system.config_file import override


def write_model(folder: Path, *changes: str) -> Path:
    """Writes and returns the folder; `changes` as on the command line, e.g. `arch.output=vector`."""
    settings = override(preset("tiny"), ["size=32", "arch.levels=2", *changes])
    torch.manual_seed(0)
    net = build("d2fnet", settings.arch).eval()
    with torch.no_grad():
        for conv in net.heads.ranges:
            conv.weight.normal_(0, 200.0)
    card = ModelCard(settings, Scales(1.0, 0.2, 1.0, 100.0, 0.3), 1.7, {}, {})
    checkpoint.write_model(folder, card, net.state_dict())
    add_onnx(folder)
    return folder
