"""A trained model as one ONNX file for other programs, which computes the input channels itself.

Inputs: `displacement` (B, 2, N, N) mm, in stereo (B, 3, N, N), and `mask` (B, 1, N, N) 0/1; for some models
`confidence` (B, 1 or, in stereo, 2, N, N) 0..1 and `membrane` (B,): -1 stripped, 0 unknown, 1 intact. Output:
force density per unit stiffness (B, C, N, N) [mN/mm² at 1 kPa]. The .json next to it describes their use, and
`NAME.onnx.example.py` runs it on one frame.
"""

from __future__ import annotations

import importlib
import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn

from learn.checkpoint import ModelCard
from learn.data.grid import HALF_SURE_MM, SMOOTHING_MM, channels
from learn.inference.predict import Predictor
from synth.errors import UserError

_EXAMPLE = Path(__file__).with_name("onnx_example.py.txt")
TOLERANCE = 1e-4  # largest difference from PyTorch allowed, in units of the training data's 99.9th percentile


class Portable(nn.Module):
    """The channels, the network and its scale in one module."""

    def __init__(self, model: nn.Module, card: ModelCard) -> None:
        super().__init__()
        self.model, self.card = model, card

    def forward(self, displacement: Tensor, mask: Tensor, *others: Tensor) -> Tensor:
        known = dict(zip(input_names(self.card)[2:], others, strict=True))
        x = channels(displacement, mask, self.card.settings.grid.pitch_mm, self.card.scales, **known)
        y: Tensor = self.model(x) * (self.card.scales.target * self.card.force_gain)
        return y


def input_names(card: ModelCard) -> list[str]:
    """Names of the file's inputs, in order."""
    arch = card.settings.arch
    return ["displacement", "mask", *["confidence"] * arch.confidence, *["membrane"] * arch.membrane]


def examples(card: ModelCard, batch: int, seed: int = 0) -> list[Tensor]:
    """Random inputs of realistic size: smooth motion over a round mask."""
    n = card.settings.size
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    parts = card.settings.arch.displacements
    a = rng.normal(size=(batch, parts, 6))
    basis = np.stack([np.ones_like(x), x, y, x * y, np.cos(3 * x), np.sin(3 * y)])
    moved = np.einsum("bck,kyx->bcyx", a, basis) * card.scales.displacement_mm / 3
    mask = np.broadcast_to(x**2 + y**2 < 0.7, (batch, 1, n, n))
    found = {
        "displacement": moved,
        "mask": mask,
        "confidence": rng.uniform(size=(batch, parts - 1, n, n)),
        "membrane": rng.integers(-1, 2, batch),
    }
    return [torch.from_numpy(np.array(found[name], np.float32)) for name in input_names(card)]


@torch.no_grad()
def export(predictor: Predictor, file: Path) -> float:
    """Writes `file` as ONNX, and a description `file`.json. Returns the largest difference from PyTorch.

    It is in units of the 99.9th percentile or of the largest output if that is more. UserError if it is above
    `TOLERANCE` (the file is removed), or if ONNX's packages are not installed.
    """
    card = predictor.card
    module = Portable(predictor.model.cpu(), card).eval()
    file.parent.mkdir(parents=True, exist_ok=True)
    cases = [examples(card, batch, seed=batch) for batch in (1, 3)]
    names, worst = input_names(card), 0.0
    session = _write(module, cases[-1], names, file)
    for inputs in cases:
        expected = module(*inputs)
        largest = max(card.scales.target, float(expected.abs().max()))
        named = {name: value.numpy() for name, value in zip(names, inputs, strict=True)}
        found = torch.from_numpy(session.run(None, named)[0])
        worst = max(worst, float((found - expected).abs().max()) / largest)
    if not worst <= TOLERANCE:
        file.unlink()
        raise UserError(f"{file}: differs from PyTorch by {worst:.1e} of full scale, at most {TOLERANCE:g}")
    file.with_suffix(file.suffix + ".json").write_text(json.dumps(describe(card, worst), indent=1))
    shutil.copyfile(_EXAMPLE, file.with_suffix(file.suffix + ".example.py"))
    return worst


def describe(card: ModelCard, difference: float) -> dict[str, Any]:
    """Contents of the .json: shapes, units and preprocessing."""
    grid, arch = card.settings.grid, card.settings.arch
    output = "density per unit stiffness, one component"
    if arch.components == 3:
        output = "force density per unit stiffness [mN/mm2 at E = 1 kPa]; components x, y, z in camera axes"
    inputs = ["flow [px] times the picture's scale [mm/px] is displacement [mm]; x right, y down"]
    if arch.depth:
        inputs = ["displacement [mm] is stereo motion in camera axes, x right, y down, z away"]
    if arch.depth and arch.confidence:
        inputs.append(
            "confidence, across and along the view: means over tissue of 1 / (1 + (s / s0)^2), "
            f"s0 = {HALF_SURE_MM} mm, s the motion's standard deviation [mm] (of dx and dy the rms)"
        )
    if arch.membrane:
        inputs.append("membrane, one number a frame: -1 stripped, 0 unknown, 1 intact")
    return {
        "format": "onnx",
        "inputs": input_names(card),
        "outputs": ["density"],
        "output": output,
        "grid": {"size": grid.size, "pitch_mm": grid.pitch_mm, "extent_mm": grid.extent_mm},
        "preprocessing": [
            *inputs,
            "the grid's centre lies on the centroid of the tissue mask in the rest picture",
            "displacement: mean over tissue pixels under hat functions as wide as the coarser of cell and "
            "pixel",
            "mask: 1 where more than half of a cell is tissue; displacement is 0 where it is 0",
            f"divergence is computed inside, from displacement smoothed with sigma {SMOOTHING_MM} mm",
        ],
        "force": "sum of the output over cells times pitch_mm^2 times E [kPa] is the total force [mN]",
        "typical_young_kpa": card.typical_young_kpa,
        "largest_difference_from_pytorch": difference,
    }


def _write(module: nn.Module, inputs: list[Tensor], names: list[str], file: Path) -> Any:
    """Writes `file`, for batches of any size, and returns a session of ONNX Runtime that runs it."""
    try:
        importlib.import_module("onnx")
    except ImportError:
        raise UserError("ONNX export needs onnx: pip install '.[export]' in the clone") from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            tuple(inputs),
            str(file),
            input_names=names,
            output_names=["density"],
            dynamic_axes={name: {0: "batch"} for name in [*names, "density"]},
            dynamo=False,
            opset_version=17,
        )
    return onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
