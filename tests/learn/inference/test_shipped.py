"""Networks that come with the package: whole, small, and the model they were packed from."""

from __future__ import annotations

import json
from pathlib import Path

import fake_model
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import learn
from learn import checkpoint
from learn.cli import app
from learn.inference import shipped
from synth.errors import UserError
from synth.system.checked_file import folder_bytes

run = CliRunner().invoke


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where networks that come along lie: none yet."""
    monkeypatch.setattr(shipped, "MODELS", tmp_path / "models")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "models"


def pack(models: Path, name: str, *changes: str) -> Path:
    """A tiny one, as if it had come along."""
    source = fake_model.write_model(models.parent / f"trained-{name}", *changes)
    shipped.pack_model(source, models / name, "c0ffee", {"error": "12% of the peak"}, ["It is for tests."])
    return models / name


def test_what_is_packed_is_the_model(models: Path) -> None:
    folder = pack(models, "mono", "arch.output=vector")
    assert sorted(path.name for path in folder.iterdir()) == [
        "README.md",
        "config.json",
        "weights.safetensors",
    ]
    both = (models.parent / "trained-mono", folder)
    before, after = (checkpoint.read_model(one)[0].state_dict() for one in both)
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)
    (row,) = json.loads(run(app, ["models", "--json"]).stdout)
    assert (row["name"], row["eyes"], row["bytes"]) == ("mono", 1, folder_bytes(folder))


def test_damage_is_found(models: Path) -> None:
    weights = pack(models, "mono") / "weights.safetensors"
    whole = weights.read_bytes()
    for broken in (whole[:-100], whole[:-1] + b"\x7f"):
        weights.write_bytes(broken)
        with pytest.raises(UserError, match="weights"):
            learn.load_model("mono")


@pytest.mark.parametrize(
    ("name", "force"), [("mono", [196.83, 500.95, -1000.8]), ("stereo", [11.898, 24.684, -8.2516])]
)
def test_the_networks_answer_as_they_did(name: str, force: list[float]) -> None:
    model, card = checkpoint.read_model(shipped.MODELS / name)
    given = np.random.default_rng(0).random((1, len(card.settings.arch.channels), 128, 128), np.float32)
    with torch.no_grad():
        found = model(torch.from_numpy(given))[0].sum(dim=(1, 2))
    np.testing.assert_allclose(found, force, rtol=1e-3)


@pytest.mark.parametrize("name", shipped.NAMES)
def test_what_lies_there_is_small_whole_and_told_of(name: str) -> None:
    if name not in shipped.shipped():
        pytest.skip("none comes with this version")
    folder = shipped.MODELS / name
    assert folder_bytes(folder) <= shipped.LARGEST_BYTES == 4_000_000
    card = learn.load_model(name).card
    assert card.settings.arch.depth == (name == "stereo")
    page = (folder / "README.md").read_text()
    assert shipped.hash_data(card) in page
    assert "Limits:" in page
