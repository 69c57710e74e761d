"""One truth of who may be trained on: a dataset that `synth split` has split keeps that split in `learn`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import phantom
import pytest
from typer.testing import CliRunner

from learn.checkpoint import read_card
from learn.cli import app
from learn.data.clips import Clip
from learn.data.split import Split, folds, keep_written, nested
from synth.cli import app as synth
from synth.dataset import split
from synth.dataset.folder import claim
from synth.dataset.index import read_index, written_sides
from synth.dataset.split import Rule
from synth.errors import UserError
from synth.job.schema import Job

run = CliRunner().invoke
TINY = ["--preset", "tiny", "--size", "32", "--width", "8", "--epochs", "1", "--json"]


@pytest.fixture
def own(dataset: Path, tmp_path: Path) -> Path:
    """The phantoms in a folder that may be split."""
    return Path(shutil.copytree(dataset, tmp_path / "own"))


def train(dataset: Path, out: Path, *extra: str) -> dict[str, list[str]]:
    done = run(app, ["train", str(dataset), "-o", str(out), *TINY, *extra])
    assert done.exit_code == 0, done.output
    assert "The dataset's own split: what `synth split` marks test" in " ".join(done.stderr.split())
    return read_card(out).split


def marked(dataset: Path) -> dict[str, set[str]]:
    sides = written_sides(dataset)
    assert sides is not None
    return {side: {key for key, on in sides.items() if on == side} for side in split.SIDES}


@pytest.mark.parametrize(
    "rule", [Rule(shares=(0.5, 0.25, 0.25)), Rule(shares=(0.6, 0.2, 0.2), held_out=("pale",))]
)
def test_what_is_marked_is_what_is_fitted_chosen_and_scored(own: Path, tmp_path: Path, rule: Rule) -> None:
    split.keep_rule(own, rule)
    on = marked(own)
    assert all(on.values())
    used = train(own, tmp_path / "m")
    assert [set(used[part]) for part in ("fit", "select", "test")] == [on[side] for side in split.SIDES]
    done = run(app, ["eval", str(tmp_path / "m"), str(own), "--json"])
    assert done.exit_code == 0, done.output
    assert len(json.loads(done.stdout)["sequences"]) == len(on["test"])


def test_eval_asks_the_held_out_set_of_a_model_that_knew_of_none(own: Path, tmp_path: Path) -> None:
    done = run(app, ["train", str(own), "-o", str(tmp_path / "m"), "--folds", "3", *TINY])
    assert done.exit_code == 0, done.output
    unseen = set(read_card(tmp_path / "m").split["test"])
    split.keep_rule(own, Rule(shares=(0.25, 0.25, 0.5)))
    held = unseen & marked(own)["test"]
    assert 0 < len(held) < len(unseen)
    done = run(app, ["eval", str(tmp_path / "m"), str(own), "--json"])
    assert len(json.loads(done.stdout)["sequences"]) == len(held)
    everything = run(app, ["eval", str(tmp_path / "m"), str(own), "--json", "--all"])
    assert len(json.loads(everything.stdout)["sequences"]) == 8


def test_without_a_validation_side_a_part_of_the_training_side_chooses(own: Path, tmp_path: Path) -> None:
    split.keep_rule(own, Rule(shares=(0.7, 0.0, 0.3)))
    on = marked(own)
    used = train(own, tmp_path / "m")
    assert set(used["test"]) == on["test"]
    assert used["select"]
    assert set(used["fit"]) | set(used["select"]) == on["train"]


def test_one_brain_is_split_within_it_where_the_dataset_says_so(tmp_path: Path) -> None:
    for index in range(5):
        phantom.write(tmp_path / "own", index, anatomy_seed=1)
    split.keep_rule(tmp_path / "own", Rule("sequence", (0.6, 0.2, 0.2), share_anatomy=True))
    used = train(tmp_path / "own", tmp_path / "m")
    assert {part: len(names) for part, names in used.items()} == {"fit": 3, "select": 1, "test": 1}
    assert read_card(tmp_path / "m").settings.share_anatomy


@pytest.mark.parametrize(("by", "alike"), [("opening", True), ("sequence", False)])
def test_openings_of_one_brain_are_on_one_side_only_where_the_rule_is_by_them(
    tmp_path: Path, by: str, alike: bool
) -> None:
    own = tmp_path / "own"
    with claim(own, Job(sequences=6)):
        for index in range(6):
            phantom.write(own, index, anatomy_seed=1, opening=f"mesh-5f at {index // 2}, 0, 0")
    done = run(synth, ["split", str(own), "--by", by, "--shares", "0.4,0.3,0.3", "--share-anatomy"])
    assert done.exit_code == 0, done.output
    assert f"warning: 1 brain is on several sides: {by}s of one brain are no strangers" in done.stderr
    used = train(own, tmp_path / "m")
    opening = {row["content_hash"]: row["opening"] for row in read_index(own).to_pylist()}
    assert len(set(opening.values())) == 3
    seen = [opening[name] for part in ("fit", "select", "test") for name in used[part]]
    assert len(seen) == 6
    sides = [{opening[name] for name in used[part]} for part in ("fit", "select", "test")]
    assert (sum(map(len, sides)) == 3) == alike
    # The model is asked about none of its own openings, in a dataset of fewer of them as well.
    other = tmp_path / "other"
    phantom.write(other, 7, anatomy_seed=1, opening=opening[used["fit"][0]])
    asked = run(app, ["eval", str(tmp_path / "m"), str(other), "--json"])
    assert (asked.exit_code == 2 and "fitted or chosen on every sequence" in asked.stderr) == alike


def test_two_datasets_are_trained_on_as_one(own: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    for index in range(4):
        phantom.write(other, index, anatomy_seed=50 + index)
    given = ["--also", str(other), "--folds", "3", *TINY]
    done = run(app, ["train", str(own), "-o", str(tmp_path / "m"), *given])
    assert done.exit_code == 0, done.output
    used = read_card(tmp_path / "m").split
    assert sum(map(len, used.values())) == 12
    # Nothing that is in both is on two sides.
    done = run(app, ["train", str(own), "--also", str(own), "-o", str(tmp_path / "n"), "--folds", "3", *TINY])
    assert done.exit_code == 0, done.output
    sides = [set(names) for names in read_card(tmp_path / "n").split.values()]
    assert sum(map(len, sides)) == len(set.union(*sides)) == 8


def test_datasets_that_are_split_by_different_rules_are_not_trained_on_together(
    own: Path, tmp_path: Path
) -> None:
    other = Path(shutil.copytree(own, tmp_path / "other"))
    split.keep_rule(own, Rule(shares=(0.5, 0.25, 0.25)))
    for first, second in ((own, other), (other, own)):
        done = run(app, ["train", str(first), "--also", str(second), "-o", str(tmp_path / "m"), *TINY])
        assert done.exit_code == 2
        assert f"{second}: is not split as {first} is" in " ".join(done.stderr.split())
    split.keep_rule(other, Rule(shares=(0.5, 0.25, 0.25)))
    used = train(own, tmp_path / "m", "--also", str(other))
    assert set(used["test"]) == marked(own)["test"]


def test_an_anatomy_that_two_splits_put_on_two_sides_is_refused(own: Path, tmp_path: Path) -> None:
    rule = Rule(shares=(0.5, 0.25, 0.25))
    split.keep_rule(own, rule)
    # A brain of the first beside strangers is dealt anew there, until it is on another side.
    for brain in range(1, 7):
        other = tmp_path / f"other-{brain}"
        for index, seed in enumerate((brain, *range(10 * brain, 10 * brain + 3))):
            phantom.write(other, 20 + index, anatomy_seed=seed)
        split.keep_rule(other, rule)
        done = run(app, ["train", str(own), "--also", str(other), "-o", str(tmp_path / f"m{brain}"), *TINY])
        if done.exit_code:
            assert "1 of the anatomies are on two sides" in " ".join(done.stderr.split())
            return
    pytest.fail("no brain was dealt to two sides")


def test_a_sequence_that_comes_later_has_its_side_too(own: Path) -> None:
    split.keep_rule(own, Rule())
    before = marked(own)
    phantom.write(own, 8, anatomy_seed=9)
    assert sum(map(len, marked(own).values())) == sum(map(len, before.values())) + 1


def test_folds_of_ones_own_do_not_go_with_a_written_split(own: Path, tmp_path: Path) -> None:
    split.keep_rule(own, Rule())
    for extra in (["--fold", "1"], ["--folds", "3"], ["--hold-out", "pale"]):
        done = run(app, ["train", str(own), "-o", str(tmp_path / "m"), *TINY, *extra])
        assert done.exit_code == 2
        assert "is split already (split.json, by `synth split`): leave out " in done.stderr
        assert not (tmp_path / "m").exists()


def test_a_written_split_that_leaves_nothing_to_choose_on(clips: Sequence[Clip]) -> None:
    sides = {c.content_hash: "test" for c in clips[2:]} | {c.content_hash: "train" for c in clips[:2]}
    with pytest.raises(UserError, match="1 are left of them beside the test"):
        keep_written(clips, sides, 0)


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
