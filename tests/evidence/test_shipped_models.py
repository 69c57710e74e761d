"""The experiment on networks that come along: who is asked, what its card says, what is packed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import fake_intervals
import fake_model
import phantom
import pytest

from evidence.learn import shipped as experiment
from learn.checkpoint import read_card, write_card
from learn.inference import shipped
from synth.dataset.store import Dataset
from synth.errors import UserError


@pytest.fixture
def worlds(tmp_path: Path) -> tuple[Path, Path]:
    for name, first in (("mission", 0), ("elsewhere", 10)):
        for k in range(4):
            phantom.write(tmp_path / name, k, anatomy_seed=first + k)
    return tmp_path / "mission", tmp_path / "elsewhere"


@pytest.fixture
def model(tmp_path: Path, worlds: tuple[Path, Path]) -> Path:
    """Fitted on the first sequence of `mission`."""
    folder = fake_model.write_model(
        tmp_path / "model", "arch.output=vector", "arch.confidence=true", "input=recovered"
    )
    met = next(iter(Dataset(worlds[0]))).attrs["content_hash"]
    write_card(folder, dataclasses.replace(read_card(folder), split={"fit": [met]}, groups={"fit": []}))
    return fake_intervals.give(folder, fake_intervals.make(size=1e6))


def test_every_world_is_asked_with_what_was_never_met(
    model: Path, worlds: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shipped, "MODELS", tmp_path / "models")
    mission, elsewhere = worlds
    found = experiment.experiment(mission, [f"mono={model}"], [elsewhere], None, True)
    assert [(row["asked"], row["sequences"]) for row in found["rows"]] == [("mission", 3), ("elsewhere", 4)]
    assert [row["held_size"][0] for row in found["rows"]] == [1.0, 1.0]
    assert shipped.shipped() == {"mono": tmp_path / "models/mono"}
    card = (tmp_path / "models/mono/README.md").read_text()
    assert "elsewhere, 4 sequences it never met" in card
    assert "intervals hold for 100% of frames" in card
    assert "one eye sees next to nothing" in card
    page = experiment.drawn(found)
    assert [len(section.rows) for section in page.sections] == [2, 2]


def test_only_mono_and_stereo_come_along(
    model: Path, worlds: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shipped, "MODELS", tmp_path / "models")
    found = experiment.experiment(worlds[0], [f"another={model}"], None, None, True)
    assert [row["model"] for row in found["rows"]] == ["another"]
    assert shipped.shipped() == {}
    with pytest.raises(UserError, match="--model mono: NAME=FOLDER"):
        experiment.experiment(worlds[0], ["mono"], None, None, False)
