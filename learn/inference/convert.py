"""A trained network as ONNX, which computes the input channels itself; by PyTorch, and compared with it.

Inputs: `displacement` (B, 2, N, N) mm, in stereo (B, 3, N, N), and `mask` (B, 1, N, N) 0/1; for some models
`confidence` (B, 1 or, in stereo, 2, N, N) 0..1 and `membrane` (B,): -1 stripped, 0 unknown, 1 intact. Output:
force density per unit stiffness (B, C, N, N) [mN/mm² at 1 kPa].
"""

from __future__ import annotations

import tempfile
import warnings
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from learn import checkpoint
from learn.checkpoint import ModelCard
from learn.inference.predict import input_names
from learn.network.channels import channels
from synth.errors import UserError, as_user_error
from synth.flow import onnx_network

TOLERANCE = 1e-3  # of the largest output: rounding reaches 1e-4, a wrong operation percents


class Portable(nn.Module):
    """The channels, the network and its scale in one module."""

    def __init__(self, network: nn.Module, card: ModelCard, gain: float) -> None:
        super().__init__()
        self.network, self.card, self.gain = network, card, gain

    def forward(self, displacement: Tensor, mask: Tensor, *others: Tensor) -> Tensor:
        options = dict(zip(input_names(self.card)[2:], others, strict=True))
        x = channels(displacement, mask, self.card.settings.grid.pitch_mm, self.card.scales, **options)
        y: Tensor = self.network(x) * (self.card.scales.target * self.gain)
        return y


def examples(card: ModelCard, batch: int, seed: int = 0) -> list[Tensor]:
    """Random inputs of realistic size: smooth motion over a round mask."""
    n = card.settings.size
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    parts = card.settings.arch.displacements
    a = rng.normal(size=(batch, parts, 6))
    basis = np.stack([np.ones_like(x), x, y, x * y, np.cos(3 * x), np.sin(3 * y)])
    displacement = np.einsum("bck,kyx->bcyx", a, basis) * card.scales.displacement_mm / 3
    mask = np.broadcast_to(x**2 + y**2 < 0.7, (batch, 1, n, n))
    inputs = {
        "displacement": displacement,
        "mask": mask,
        "confidence": rng.uniform(size=(batch, parts - 1, n, n)),
        "membrane": rng.integers(-1, 2, batch),
    }
    return [torch.from_numpy(np.array(inputs[name], np.float32)) for name in input_names(card)]


@torch.no_grad()
def to_onnx(
    network: nn.Module, card: ModelCard, gain: float = 1.0, tolerance: float | None = None
) -> tuple[bytes, float]:
    """The file's bytes, for batches of any size, and its largest difference from PyTorch.

    The difference is in units of the 99.9th percentile, or of the largest output if that is more. `gain`:
    factor on the output; `tolerance`: of the difference, `TOLERANCE` if None. UserError if it is above, or
    the network can't be written.
    """
    module = Portable(network.cpu(), card, gain).eval()
    cases = [examples(card, batch, seed=batch) for batch in (1, 3)]
    names, worst = input_names(card), 0.0
    with ExitStack() as stack:
        stack.enter_context(as_user_error("the network can't be written as ONNX"))
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        file = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "network.onnx"
        torch.onnx.export(
            module,
            tuple(cases[-1]),
            str(file),
            input_names=names,
            output_names=["density"],
            dynamic_axes={name: {0: "batch"} for name in [*names, "density"]},
            dynamo=False,
            opset_version=17,
        )
        data = file.read_bytes()
    session = onnx_network.open_network(data, "the network in ONNX")
    for inputs in cases:
        expected = module(*inputs)
        largest = max(card.scales.target, float(expected.abs().max()))
        feeds = {name: value.numpy() for name, value in zip(names, inputs, strict=True)}
        output = torch.from_numpy(session.run(None, feeds)[0])
        worst = max(worst, float((output - expected).abs().max()) / largest)
    if not worst <= (TOLERANCE if tolerance is None else tolerance):
        raise UserError(f"in ONNX the network differs from PyTorch by {worst:.1e} of full scale: too much")
    return data, worst


def add_onnx(folder: Path) -> ModelCard:
    """Writes the network of a model's folder as network.onnx next to its weights; returns its new card.

    UserError as `to_onnx` and `checkpoint.read_model`.
    """
    network, card = checkpoint.read_model(folder)
    return checkpoint.write_onnx(folder, card, to_onnx(network, card)[0])


def convert(folder: Path) -> bytes:
    """The network of a model's folder in ONNX. UserError as `add_onnx`."""
    return to_onnx(*checkpoint.read_model(folder))[0]
