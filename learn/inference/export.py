"""A trained model as one ONNX file for other programs: `convert.py`, with the model's gain of the force.

The .json next to it describes its use, and `NAME.onnx.example.py` runs it on one frame.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from learn import checkpoint
from learn.checkpoint import ModelCard
from learn.data.grid import HALF_SURE_MM, SMOOTHING_MM
from learn.inference.convert import to_onnx
from learn.inference.predict import input_names
from synth.system.checked_file import write_whole

_EXAMPLE = Path(__file__).with_name("onnx_example.py.txt")


def export(model: Path, file: Path) -> float:
    """Writes the model of a folder as `file`, and a description `file`.json.

    Returns the largest difference from PyTorch. UserError as `to_onnx` and `checkpoint.read_model`; nothing
    is written then.
    """
    network, card = checkpoint.read_model(model)
    data, worst = to_onnx(network, card, card.force_gain)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, data)
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
