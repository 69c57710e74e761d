"""One truth of who may be trained on: a dataset that `synth split` has split keeps that split in `learn`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import phantom
import pytest
from typer.testing import CliRunner

from learn import cli
from learn.checkpoint import read_card
from learn.data.clips import Clip, load_clips
from learn.data.split import Split, folds, nested
from learn.settings import TrainingSettings, preset, replace
from learn.training.sides import divide
from synth.cli import app as synth
from synth.dataset import index, split
from synth.dataset.folder import Folder, claim
from synth.dataset.index import read_index, written_sides
from synth.dataset.split import Rule
from synth.errors import UserError
from synth.job.schema import Job

run = CliRunner().invoke
BASE = preset("tiny", size=32)


@pytest.fixture
def own(dataset: Path, tmp_path: Path) -> Path:
    """The phantoms in a folder that may be split."""
    return Path(shutil.copytree(dataset, tmp_path / "own"))


def divided(
    *datasets: Path, settings: TrainingSettings = BASE, fixed: bool = False
) -> tuple[dict[str, set[str]], TrainingSettings]:
    """Content hashes of each part of what would be trained on, and the settings."""
    clips = [clip for one in datasets for clip in load_clips(one, settings.grid, ["ideal"])]
    clips, parts, settings = divide(clips, datasets, settings, ["folds"] * fixed)
    named = {part: {clips[i].content_hash for i in which} for part, which in vars(parts).items()}
    return named, settings


def marked(dataset: Path) -> dict[str, set[str]]:
    sides = written_sides(dataset)
    assert sides is not None
    return {side: {key for key, on in sides.items() if on == side} for side in split.SIDES}


@pytest.mark.parametrize(
    "rule", [Rule(shares=(0.5, 0.25, 0.25)), Rule(shares=(0.6, 0.2, 0.2), held_out=("pale",))]
)
def test_what_is_marked_is_what_is_fitted_chosen_and_scored(own: Path, rule: Rule) -> None:
    split.keep_rule(own, rule)
    on = marked(own)
    assert all(on.values())
    used, _ = divided(own)
    assert [used[part] for part in ("fit", "select", "test")] == [on[side] for side in split.SIDES]
    # An index that was edited moves nobody.
    index.write_index(Folder(own))
    rows = index.read_index(own).to_pylist()
    for row in rows:
        row.update(anatomy="one", split="train", content_hash="0" * 32, family="calf")
    index.save_rows(own, rows)
    assert marked(own) == on


@pytest.mark.slow
def test_train_and_eval_keep_to_it(own: Path, tmp_path: Path) -> None:
    words = ["--preset", "tiny", "--epochs", "1", "--json", "size=32", "arch.width=8"]
    done = run(cli.app, ["train", str(own), "-o", str(tmp_path / "before"), "folds=3", *words])
    assert done.exit_code == 0, done.output
    split.keep_rule(own, Rule(shares=(0.5, 0.25, 0.25)))
    done = run(cli.app, ["train", str(own), "-o", str(tmp_path / "after"), *words])
    assert done.exit_code == 0, done.output
    test = marked(own)["test"]
    assert set(read_card(tmp_path / "after").split["test"]) == test
    # A model that knew of no split is asked about what is marked test and it has not met.
    for model in ("before", "after"):
        card = read_card(tmp_path / model)
        asked = test - {name for part in ("fit", "select") for name in card.split[part]}
        done = run(cli.app, ["eval", str(tmp_path / model), str(own), "--json"])
        assert done.exit_code == (0 if asked else 2), done.output
        assert not asked or len(json.loads(done.stdout)["sequences"]) == len(asked)


@pytest.mark.parametrize(("by", "alike"), [("opening", True), ("sequence", False)])
def test_openings_of_one_brain_are_on_one_side_only_where_the_rule_is_by_them(
    tmp_path: Path, by: str, alike: bool
) -> None:
    own = tmp_path / "own"
    with claim(own, Job(sequences=6)):
        for number in range(6):
            phantom.write(own, number, anatomy_seed=1, opening=f"mesh-5f at {number // 2}, 0, 0")
    done = run(synth, ["split", str(own), "--by", by, "--shares", "0.4,0.3,0.3", "--share-anatomy"])
    assert done.exit_code == 0, done.output
    used, settings = divided(own)
    assert settings.share_anatomy
    opening = {row["content_hash"]: row["opening"] for row in read_index(own).to_pylist()}
    sides = [{opening[name] for name in used[part]} for part in ("fit", "select", "test")]
    assert all(sides)
    assert (sum(map(len, sides)) == len(set(opening.values())) == 3) == alike


def test_two_datasets_are_trained_on_as_one(own: Path, tmp_path: Path) -> None:
    other, fixed = tmp_path / "other", replace(BASE, folds=3)
    for number in range(4):
        phantom.write(other, number, anatomy_seed=50 + number)
    used, _ = divided(own, other, settings=fixed, fixed=True)
    assert sum(map(len, used.values())) == 12
    # Nothing that is in both is on two sides.
    used, _ = divided(own, own, settings=fixed, fixed=True)
    assert sum(map(len, used.values())) == len(set.union(*used.values())) == 8
    # Split alike, or not at all.
    rule = Rule(shares=(0.5, 0.25, 0.25))
    split.keep_rule(own, rule)
    for both in ((own, other), (other, own)):
        with pytest.raises(UserError, match="split"):
            divided(*both)
    split.keep_rule(other, rule)
    assert divided(own, other)[0]["test"] == marked(own)["test"] | marked(other)["test"]


def test_an_anatomy_that_two_splits_put_on_two_sides_is_refused(own: Path, tmp_path: Path) -> None:
    rule = Rule(shares=(0.5, 0.25, 0.25))
    split.keep_rule(own, rule)

    # A brain of the first beside strangers is dealt anew there, until it is on another side.
    def others() -> Iterator[Path]:
        for brain in range(1, 7):
            other = tmp_path / f"other-{brain}"
            for number, seed in enumerate((brain, *range(10 * brain, 10 * brain + 3))):
                phantom.write(other, 20 + number, anatomy_seed=seed)
            split.keep_rule(other, rule)
            yield other

    with pytest.raises(UserError, match="--also"):
        [divided(own, other) for other in others()]


def test_without_a_written_split_the_folds_are_those_they_always_were(
    dataset: Path, clips: list[Clip]
) -> None:
    assert written_sides(dataset) is None
    assert folds(clips, 3, 0) == [(3, 4, 6), (0, 1, 2), (5, 7)]
    assert [nested(clips, 3, fold, 0) for fold in range(3)] == [
        Split((2, 5, 7), (0, 1), (3, 4, 6)),
        Split((5, 6, 7), (3, 4), (0, 1, 2)),
        Split((0, 1, 2, 6), (3, 4), (5, 7)),
    ]
