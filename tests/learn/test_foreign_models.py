"""Untrusted and damaged models: card and weights are read, or refused with a one-line error."""

import hashlib
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import fake_model
import phantom
import pytest
import safetensors.torch
import torch
from command import run

from learn.checkpoint import read_card, read_model, read_tensors, save_tensors, write_card, write_model
from learn.cli import app
from synth.errors import UserError


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model and a store of its grid."""
    root = tmp_path_factory.mktemp("pristine")
    phantom.write(root, 0, anatomy_seed=1, frames=3)
    fake_model.write_model(root / "model")
    return root


@pytest.fixture
def model(pristine: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine / "model", tmp_path / "model"))


def damage(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 64
    file.write_bytes(data)


def test_an_edited_or_invalid_card_is_refused_in_one_line(model: Path, pristine: Path) -> None:
    file, card = model / "config.json", read_card(model)
    edited_text = file.read_text().replace('"typical_young_kpa": 1.7', '"typical_young_kpa": 17')
    write_card(model, replace(card, scales=replace(card.scales, displacement_mm=0.0)))
    for text, match in ((file.read_text(), r"scales\.displacement_mm"), ("[]", ""), (edited_text, "")):
        file.write_text(text)
        with pytest.raises(UserError, match=rf"config\.json.*{match}"):
            read_model(model)
    assert run(app, "calibrate", model, pristine / "000000.zarr", code=2).stderr.count("\n") == 1


def test_a_flipped_bit_of_weights_and_of_a_state_of_training_is_found(model: Path) -> None:
    damage(model / "weights.safetensors")
    with pytest.raises(UserError, match=r"weights\.safetensors"):
        read_model(model)
    state = model / "last.pt"
    save_tensors(state, {"weights": torch.arange(10_000)})
    damage(state)
    assert torch.load(state, weights_only=True), "PyTorch now checks the archive's checksums itself"
    with pytest.raises(UserError, match="checksum"):
        read_tensors(state)


def test_a_kill_between_card_and_weights_leaves_a_model(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    initial = safetensors.torch.load_file(model / "weights.safetensors")
    state = {name: value * 2 for name, value in initial.items()}
    card = read_card(model)
    for dies_at in ("write_card", "os.replace"):
        before = {name: value.clone() for name, value in read_model(model)[0].state_dict().items()}

        with monkeypatch.context() as patch:
            patch.setattr(f"learn.checkpoint.{dies_at}", Mock(side_effect=KeyboardInterrupt))
            if dies_at == "os.replace":
                patch.setattr("learn.checkpoint._write", lambda file, data: file.write_bytes(data))
            with pytest.raises(KeyboardInterrupt):
                write_model(model, card, state)
        weights = read_model(model)[0].state_dict()
        expected = before if dies_at == "write_card" else state
        assert all(torch.equal(weights[name], value) for name, value in expected.items())


class Code:
    """Runs a command when it is unpickled."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, ("touch ran",)


def replace_weights(model: Path, data: bytes) -> None:
    """Other weights, with a card that has their hash."""
    (model / "weights.safetensors").write_bytes(data)
    weights_hash = hashlib.blake2b(data, digest_size=16).hexdigest()
    write_card(model, replace(read_card(model), weights_hash=weights_hash))


def test_files_that_are_no_weights_are_refused(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(model)
    for content in ({"x": torch.zeros(3)}, {}):
        replace_weights(model, safetensors.torch.save(content))
        with pytest.raises(UserError, match="weights"):
            read_model(model)
    torch.save({"x": Code()}, "last.pt")
    replace_weights(model, Path("last.pt").read_bytes())
    for read, file in ((read_model, model), (read_tensors, model / "last.pt")):
        with pytest.raises(UserError) as caught:
            read(file)
        assert "weights_only" not in str(caught.value)  # PyTorch's advice to run the code
    assert not Path("ran").exists()
