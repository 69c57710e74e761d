"""A model folder of an untrained network whose random weights predict non-zero forces."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

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
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in _make_files(changes).items():
        (folder / name).write_bytes(data)
    return folder


@cache  # torch exports a network for a second
def _make_files(changes: tuple[str, ...]) -> dict[str, bytes]:
    settings = override(preset("tiny"), ["size=32", "arch.levels=2", *changes])
    torch.manual_seed(0)
    net = build("d2fnet", settings.arch).eval()
    with torch.no_grad():
        for conv in net.heads.ranges:
            conv.weight.normal_(0, 200.0)
    card = ModelCard(settings, Scales(1.0, 0.2, 1.0, 100.0, 0.3), 1.7, {}, {})
    with TemporaryDirectory() as folder:
        checkpoint.write_model(Path(folder), card, net.state_dict())
        add_onnx(Path(folder))
        return {file.name: file.read_bytes() for file in Path(folder).iterdir()}
