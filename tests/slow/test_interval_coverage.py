"""From a dataset to forces with intervals, with phantoms, a tiny network and brains that are new to it."""

import json
from pathlib import Path
from typing import Any

import phantom
import pytest
from command import run

from learn.checkpoint import read_card
from learn.cli import app
from synth.dataset import sequence_split
from synth.dataset.sequence_split import DatasetSplit

BRAINS = 90
TINY = ["--preset", "tiny", "size=32", "arch.width=8", "--json"]


def run_json(*words: object) -> dict[str, Any]:
    return dict(json.loads(run(app, *words).stdout.splitlines()[-1]))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("many")
    for index in range(BRAINS):
        phantom.write(folder, index, anatomy_seed=index)
    sequence_split.store(folder, DatasetSplit(shares=(0.4, 0.3, 0.3)))
    return folder


@pytest.fixture(scope="module")
def model(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "model"
    result = run_json("train", dataset, "-o", out, "--input", "recovered", "--epochs", 6, *TINY)
    assert result["intervals"] >= 9
    return out


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sequences of other mechanics: the same forces move the tissue in a wider area."""
    folder, usual = tmp_path_factory.mktemp("foreign"), phantom.displacement

    def widen(x: Any, y: Any, force: Any, young: float) -> Any:
        return 3 * usual(x / 8, y / 8, force, young)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(phantom, "displacement", widen)
        for index in range(500, 512):
            phantom.write(folder, index, anatomy_seed=index)
    return folder


@pytest.mark.trial
def test_new_brains_are_covered_and_other_mechanics_widen_intervals(
    model: Path, dataset: Path, foreign: Path
) -> None:
    card = read_card(model)
    assert card.intervals is not None
    assert card.intervals.units == len(card.groups["intervals"]) >= 9
    others = {*card.groups["fit"], *card.groups["select"], *card.groups["test"]}
    assert not set(card.groups["intervals"]) & others
    assert card.no_intervals == ""
    wide, _ = run_json("eval", model, dataset, "--json")["coverage"]
    assert wide["level"] == 0.9
    # 27 sequences: a share of 0.9 has a standard error of 0.06 if each held or failed as a whole.
    for name in ("size", "x", "y", "z"):
        assert wide[name]["mean"] > 0.9 - 3 * 0.06, name
    assert wide["out_of_distribution"] < 0.15
    # A component that one camera can't measure has an interval too.
    assert wide["width_z_mn"] > 0
    other, _ = run_json("eval", model, foreign, "--json")["coverage"]
    assert other["out_of_distribution"] > 0.5
    assert other["width_mn"] > 2 * wide["width_mn"]
    assert other["size"]["mean"] > 0.8
