"""Untrusted and damaged models: card and weights are read, or refused with a one-line error."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import fake_model
import numpy as np
import phantom
import pytest
import torch
from typer.testing import CliRunner

from learn import checkpoint
from learn.checkpoint import load_tensors, read_card, read_model, write_model
from learn.cli import app
from synth.errors import UserError
from synth.job import identity

run = CliRunner().invoke


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


def reseal(folder: Path, *at: str, value: Any) -> None:
    """Changes a value of the card and computes a valid seal."""
    tree = json.loads((folder / "config.json").read_text())
    block = tree
    for key in at[:-1]:
        block = block[key]
    block[at[-1]] = value
    del tree["seal"]
    tree["seal"] = checkpoint._hash(identity.canonical(tree))
    (folder / "config.json").write_text(json.dumps(tree))


def test_an_edited_or_invalid_card_is_refused_in_one_line(model: Path, pristine: Path) -> None:
    file, text = model / "config.json", (model / "config.json").read_text()
    for wrong in (text.replace('"typical_young_kpa": 1.7', '"typical_young_kpa": 17'), "[]"):
        assert wrong != text
        file.write_text(wrong)
        with pytest.raises(UserError, match=r"config\.json"):
            read_model(model)
    done = run(app, ["calibrate", str(model), str(pristine / "000000.zarr")])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    file.write_text(text)
    reseal(model, "scales", "displacement_mm", value=0)
    with pytest.raises(UserError, match=r"scales\.displacement_mm"):
        read_card(model)


def test_a_flipped_bit_of_the_weights_is_found(model: Path) -> None:
    whole = (model / "weights.pt").read_bytes()
    rng = np.random.default_rng(0)
    for at in rng.integers(len(whole), size=5):
        data = bytearray(whole)
        data[at] ^= 1 << int(rng.integers(8))
        (model / "weights.pt").write_bytes(data)
        with pytest.raises(UserError, match=r"weights\.pt"):
            read_model(model)


def test_a_damaged_state_of_training_is_found(model: Path) -> None:
    """By the archive's checksums, which PyTorch ignores."""
    state = model / "last.pt"
    checkpoint.save_tensors(state, {"weights": torch.arange(10_000)})
    data = bytearray(state.read_bytes())
    data[len(data) // 2] ^= 64
    state.write_bytes(data)
    assert torch.load(state, weights_only=True), "PyTorch now checks them itself"
    with pytest.raises(UserError, match="checksum"):
        load_tensors(state)


def test_a_kill_between_card_and_weights_leaves_a_model(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = {name: value * 2 for name, value in load_tensors(model / "weights.pt").items()}
    card = read_card(model)
    for dies_at in ("write_card", "os.replace"):
        before = {name: value.clone() for name, value in read_model(model)[0].state_dict().items()}

        def die(*_: object) -> None:
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(f"learn.checkpoint.{dies_at}", die)
            if dies_at == "os.replace":
                patch.setattr("learn.checkpoint._write", lambda file, data: file.write_bytes(data))
            with pytest.raises(KeyboardInterrupt):
                write_model(model, card, state)
        there = read_model(model)[0].state_dict()
        expected = before if dies_at == "write_card" else state
        assert all(torch.equal(there[name], value) for name, value in expected.items())


class Code:
    """Runs a command when it is unpickled."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, ("touch ran",)


@pytest.mark.parametrize(
    "make",
    [
        lambda file: torch.save({"x": Code()}, file),
        lambda file: torch.save({"x": torch.zeros(1).expand(10_000_000_000)}, file),  # 40 GB of one number
        lambda file: torch.save({"x": torch.zeros(3)}, file),
    ],
    ids=["code", "bomb", "other names"],
)
def test_files_that_are_no_weights_are_refused(
    model: Path, make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(model)
    make(model / "weights.pt")
    reseal(model, "weights_hash", value=checkpoint._hash((model / "weights.pt").read_bytes()))
    with pytest.raises(UserError, match="weights"):
        read_model(model)
    assert not (model / "ran").exists()
