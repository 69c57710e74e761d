"""Pretrained networks: complete, small, and equal to the models they were packed from."""

import json
from dataclasses import replace
from pathlib import Path

import fake_model
import numpy as np
import pytest
import torch
from command import run

import learn
from learn import checkpoint
from learn.cli import app
from learn.inference import shipped_networks
from synth.flow.estimator import name_motion
from synth.system.checked_file import folder_bytes
from weights.pack import LARGEST_BYTES, pack_model

FILES = ("README.md", "config.json", "network.onnx", "weights.safetensors")


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in place of the pretrained networks."""
    monkeypatch.setattr(shipped_networks, "MODELS", tmp_path / "models")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "models"


def pack(models: Path, name: str, *changes: str) -> Path:
    """A tiny pretrained network."""
    source = fake_model.write_model(models.parent / f"trained-{name}", *changes)
    pack_model(source, models / name, "c0ffee", {"error": "12% of the peak"}, ["It is for tests."])
    return models / name


def test_a_packed_model_is_equal(models: Path) -> None:
    folder = pack(models, "stereo", "arch.output=vector")
    assert {path.name for path in folder.iterdir()} == set(FILES)
    folders = (models.parent / "trained-stereo", folder)
    before, after = (checkpoint.read_model(model_folder)[0].state_dict() for model_folder in folders)
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)
    row = json.loads(run(app, "models", "--json").stdout)[0]
    assert (row["name"], row["cameras"], row["bytes"]) == ("stereo", 1, folder_bytes(folder))


def test_the_pretrained_network_predicts_the_same_as_before() -> None:
    model, card = checkpoint.read_model(shipped_networks.MODELS / "stereo")
    inputs = np.random.default_rng(0).random((1, len(card.settings.arch.channels), 128, 128), np.float32)
    with torch.no_grad():
        force = model(torch.from_numpy(inputs))[0].sum(dim=(1, 2))
    np.testing.assert_allclose(force, [-4.8721, 52.614, 4.4076], rtol=1e-3)


@pytest.mark.parametrize("name", shipped_networks.NAMES)
def test_pretrained_networks_are_small_complete_and_documented(name: str) -> None:
    folder, card = shipped_networks.MODELS / name, learn.load_model(name).card
    assert {file.name for file in folder.iterdir()} == set(FILES)
    assert max(file.stat().st_size for file in folder.iterdir()) <= LARGEST_BYTES == 4_000_000
    assert card.settings.arch.depth
    for motion, doubts in ((["tvl1 0"], 1), ([], 1), ([name_motion("tvl1")], 0)):
        assert len(replace(card, motion=motion).doubt(name_motion("tvl1"))) == doubts
    assert shipped_networks.hash_data(card) in (folder / "README.md").read_text()
