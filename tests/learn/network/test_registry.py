"""Networks by name: each is trained, stored and used in the same way, and equals PyTorch as ONNX."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import fake_model
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from learn import checkpoint
from learn.checkpoint import read_card, read_model, write_card
from learn.data.clips import Clip
from learn.inference import shipped_networks
from learn.inference.convert import Portable, examples
from learn.inference.predict import Predictor, input_names, load_model
from learn.network.registry import NETWORKS, Network, build
from learn.network.ridge import LinearMap, solve
from learn.network.shape import LinearShape, Shape
from learn.settings import TrainingSettings, change_preset, preset
from learn.split import Split
from learn.training.train import train
from synth.errors import Caution, UserError
from synth.job.types import MembraneState
from synth.system.config_file import override

TOLERANCE = 1e-4  # of the largest output
STATES: dict[int, MembraneState] = {-1: "stripped", 0: "unknown", 1: "intact"}


def by_pytorch(folder: Path, inputs: list[Tensor]) -> np.ndarray:
    network, card = read_model(folder)
    with torch.no_grad():
        return Portable(network, card, card.force_gain)(*inputs).numpy()


def by_onnx(predictor: Predictor, inputs: list[Tensor]) -> np.ndarray:
    named = dict(zip(input_names(predictor.card), (tensor.numpy() for tensor in inputs), strict=True))
    states = [STATES[int(k)] for k in named.get("membrane", np.zeros(len(named["displacement"])))]

    def run(k: slice, state: MembraneState) -> np.ndarray:
        confidence = named["confidence"][k] if "confidence" in named else None
        return predictor.density(named["displacement"][k], named["mask"][0, 0], 1.0, confidence, state)

    if len(set(states)) == 1:
        return run(slice(None), states[0])
    return np.concatenate([run(slice(k, k + 1), state) for k, state in enumerate(states)])


def assert_equal(actual: np.ndarray, expected: np.ndarray) -> None:
    largest = np.abs(expected).max()
    assert largest > 0
    np.testing.assert_allclose(actual, expected, rtol=0, atol=TOLERANCE * largest)


@pytest.mark.parametrize("name", shipped_networks.NAMES)
def test_the_pretrained_networks_equal_pytorch(name: str) -> None:
    folder, predictor = shipped_networks.MODELS / name, load_model(name)
    for batch in (1, 20):  # a frame, and more than a batch of training
        inputs = examples(predictor.card, batch, seed=batch)
        assert_equal(by_onnx(predictor, inputs), by_pytorch(folder, inputs))


@pytest.mark.parametrize("changes", [(), ("arch.output=magnitude",), ("arch.relative=true", "arch.stem=4")])
def test_any_architecture_equals_pytorch_on_any_number_of_threads(
    changes: tuple[str, ...], tmp_path: Path
) -> None:
    folder = fake_model.write_model(tmp_path / "model", *changes)
    write_card(folder, replace(read_card(folder), force_gain=1.3))
    inputs = examples(read_card(folder), 2)
    for threads in (1, 2):
        assert_equal(by_onnx(load_model(folder, threads=threads), inputs), by_pytorch(folder, inputs))


def test_a_model_without_onnx_is_converted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = fake_model.write_model(tmp_path / "model")
    inputs = examples(read_card(folder), 1)
    expected = by_onnx(load_model(folder), inputs)
    (folder / "network.onnx").unlink()
    write_card(folder, replace(read_card(folder), onnx_hash=""))
    monkeypatch.setattr("synth.system.cache.folder", lambda name: tmp_path / name)
    (tmp_path / "networks").mkdir()
    with pytest.warns(Caution):
        assert_equal(by_onnx(load_model(folder), inputs), expected)
    assert_equal(by_onnx(load_model(folder), inputs), expected)  # a second warning would be an error
    assert not [*folder.glob("*.onnx")]


def test_a_damaged_or_foreign_onnx_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = fake_model.write_model(tmp_path / "model")
    file, card = folder / "network.onnx", read_card(folder)
    good = file.read_bytes()

    def refuses(match: str = r"network\.onnx") -> None:
        with pytest.raises(UserError, match=match):
            load_model(folder)

    file.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    refuses()
    file.unlink()
    refuses()
    checkpoint.write_onnx(folder, card, b"no network")
    refuses()
    other = fake_model.write_model(tmp_path / "other", "arch.confidence=true") / "network.onnx"
    checkpoint.write_onnx(folder, card, other.read_bytes())
    refuses()
    checkpoint.write_onnx(folder, card, good)
    assert load_model(folder).card.onnx_hash == card.onnx_hash
    monkeypatch.setattr(checkpoint, "_LARGEST_ONNX", len(good) - 1)
    refuses("MB")


def test_ridge_finds_the_linear_map_of_its_data() -> None:
    def fine(blocks: Tensor) -> Tensor:
        return blocks.repeat_interleave(2, -1).repeat_interleave(2, -2)

    random = torch.Generator().manual_seed(0)
    true, coarse = torch.randn(48, 32, generator=random), torch.randn(200, 2, 4, 4, generator=random)
    x = torch.zeros(200, 5, 8, 8)
    x[:, :2], x[:, 3] = fine(coarse), 1
    y = fine((coarse.flatten(1) @ true.T).unflatten(1, (3, 4, 4)))
    network = LinearMap(LinearShape(output="vector", cells=4, strength=1e-9))
    assert not network(x).any(), "before it is fitted it states no force"
    solve(network, [(x[:90], y[:90]), (x[90:], y[90:])])
    torch.testing.assert_close(network.linear.weight.detach(), true, rtol=1e-4, atol=1e-4)
    assert not network(x * torch.tensor([1, 1, 1, 0, 1])[:, None, None]).any(), "none outside the tissue"


class OwnShape(Shape):
    edge: int = 2


class Own(nn.Module):
    """A plain convolution."""

    def __init__(self, shape: OwnShape) -> None:
        super().__init__()
        self.layer = nn.Conv2d(len(shape.channels), shape.components, shape.edge, padding="same")

    def forward(self, x: Tensor) -> Any:
        return self.layer(x) * x[:, 3:4]


@pytest.mark.parametrize("name", ["ridge", "mine"])
def test_another_network_goes_through_the_same_door(
    clips: list[Clip], tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(NETWORKS, "_added", {"mine": Network(OwnShape, Own)})
    settings = override(preset("ridge"), ["size=32", "arch.cells=8"])
    if name == "mine":
        settings = TrainingSettings(size=32, network="mine", arch={"edge": 3}, loss="mse", epochs=2)  # type: ignore[arg-type]
    card = train(clips, Split((2, 5, 7), (0, 1), (3, 4, 6)), settings, tmp_path / "model")
    assert card == read_card(tmp_path / "model")
    assert (card.settings, type(card.settings.arch)) == (settings, NETWORKS.load(name).shape)
    inputs = examples(card, 2)
    assert_equal(by_onnx(load_model(tmp_path / "model"), inputs), by_pytorch(tmp_path / "model", inputs))


@pytest.mark.parametrize(
    ("start", "change"),
    [("tiny", "network=nonesuch"), ("ridge", "arch.width=8"), ("ridge", "arch.cells=x"), ("tiny", "loss=l1")],
)
def test_a_wrong_setting_of_a_network_is_named(start: str, change: str) -> None:
    with pytest.raises(UserError, match=change.partition("=")[0].replace(".", r"\.")):
        override(preset(start), [change])


def test_a_preset_of_one_kind_of_network_is_a_start_for_another() -> None:
    settings = change_preset("stereo", {"network": "ridge", "arch.cells": "8", "size": "64"})
    assert settings.arch == LinearShape(cells=8, confidence=True, depth=True)
    assert settings.input == preset("stereo").input
    assert change_preset("cpu", {"epochs": "3"}) == preset("cpu", epochs=3)
    with pytest.raises(UserError, match="nonesuch"):
        change_preset("cpu", {"network": "nonesuch"})


def test_faults_of_another_package_are_one_line_that_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = Network(Shape, lambda shape: 1 / 0)  # type: ignore[arg-type, return-value]
    monkeypatch.setattr(NETWORKS, "_added", {"broken": broken, "odd": object()})
    for name in ("broken", "odd"):
        with pytest.raises(UserError, match=name):
            build(name, Shape())
