"""From a dataset to forces with intervals: phantoms of a closed form, a tiny network, brains it never met."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import phantom
import pytest
from typer.testing import CliRunner

from learn.checkpoint import read_card
from learn.cli import app
from synth.dataset import split
from synth.dataset.split import Rule

BRAINS = 90
TINY = ["--preset", "tiny", "--size", "32", "--width", "8", "--epochs", "6", "--json"]


def run(*words: str) -> dict[str, Any]:
    done = CliRunner().invoke(app, list(words))
    assert done.exit_code == 0, done.output
    return dict(json.loads(done.stdout.splitlines()[-1]))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("many")
    for index in range(BRAINS):
        phantom.write(folder, index, anatomy_seed=index)
    split.keep_rule(folder, Rule(shares=(0.4, 0.3, 0.3)))
    return folder


@pytest.fixture(scope="module")
def model(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "model"
    told = run("train", str(dataset), "-o", str(out), "--input", "recovered", *TINY)
    assert told["intervals"] >= 9
    return out


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tissue that moves along with all that is near: another mechanics, its forces as before."""
    folder, usual = tmp_path_factory.mktemp("foreign"), phantom.displacement

    def dragged(x: Any, y: Any, force: Any, young: float) -> Any:
        return 3 * usual(x / 8, y / 8, force, young)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(phantom, "displacement", dragged)
        for index in range(500, 512):
            phantom.write(folder, index, anatomy_seed=index)
    return folder


def test_intervals_are_of_brains_that_were_neither_fitted_nor_chosen_on(model: Path) -> None:
    card = read_card(model)
    assert card.intervals is not None
    assert card.no_intervals == ""
    assert card.intervals.units == len(card.groups["intervals"]) >= 9
    for one in ("fit", "select", "test"):
        assert not set(card.groups[one]) & set(card.groups["intervals"])


def test_unseen_brains_are_covered_and_another_mechanics_widens(
    model: Path, dataset: Path, foreign: Path
) -> None:
    wide, _ = run("eval", str(model), str(dataset), "--json")["coverage"]
    assert wide["level"] == 0.9
    # 27 sequences: a share of 0.9 has a standard error of 0.06 if each held or failed as a whole.
    for name in ("size", "x", "y", "z", "map"):
        assert wide[name]["mean"] > 0.9 - 3 * 0.06, name
    assert wide["unseen"] < 0.15
    # What one eye can't see is not said to be small.
    assert wide["width_z_mn"] > 0
    other, _ = run("eval", str(model), str(foreign), "--json")["coverage"]
    assert other["unseen"] > 0.5
    assert other["width_mn"] > 2 * wide["width_mn"]
    assert other["size"]["mean"] > 0.8


def test_predict_writes_them_and_says_what_is_unseen(
    model: Path, dataset: Path, foreign: Path, tmp_path: Path
) -> None:
    run("predict", str(model), str(dataset / "000000.zarr"), "--out", str(tmp_path), "--json")
    run("predict", str(model), str(foreign), "--out", str(tmp_path), "--json")
    with np.load(tmp_path / "000000.npz") as file:
        found = dict(file)
    assert (found["low_mn"] <= found["total_force_mn"]).all()
    assert (found["total_force_mn"] <= found["high_mn"]).all()
    assert (found["low_mn"] <= found["low68_mn"]).all()
    assert (found["high68_mn"] <= found["high_mn"]).all()
    assert found["force_low_mn"].shape == found["force_high_mn"].shape == (6, 3)
    assert found["density_low"].shape == found["density_high"].shape == (6, 32, 32)
    assert not [note for note in found["notes"] if "unseen" in note]
    told = []
    for one in foreign.glob("*.zarr"):
        with np.load(tmp_path / f"{one.stem}.npz") as file:
            told += [note for note in file["notes"] if "unseen world" in note]
    # Of a press that moves hardly anything nothing can be told.
    assert len(told) > 6
    assert "times what 99% of held-out frames" in told[0]


def test_a_model_from_before_gets_them_of_half_its_test(dataset: Path, tmp_path: Path) -> None:
    """Without a split of its own this dataset has too few brains to keep any back."""
    plain = tmp_path / "data"
    plain.mkdir()
    for one in dataset.glob("*.zarr"):
        shutil.copytree(one, plain / one.name)
    out = tmp_path / "model"
    run("train", str(plain), "-o", str(out), "--input", "recovered", *TINY[:-2], "1", "--json")
    card = read_card(out)
    assert card.intervals is None
    assert card.no_intervals == "0 brains are kept for intervals; 90% intervals need 9"
    refused = CliRunner().invoke(app, ["intervals", str(out), str(plain)])
    assert refused.exit_code == 2
    assert "say --from-test" in " ".join(refused.stderr.split())
    found = run("intervals", str(out), str(plain), "--from-test", "--json")
    assert found["units"] == 9
    after = read_card(out)
    assert after.intervals is not None
    assert len(after.split["test"]) == len(card.split["test"]) - 9
    scored = run("eval", str(out), str(plain), "--json")
    assert len(scored["sequences"]) == len(after.split["test"])
