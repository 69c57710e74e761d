"""One split per dataset, used for export, training, validation, scores and intervals."""

import csv
import json
import tarfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import phantom
import pyarrow.parquet as pq
import pytest
from command import run

from learn import cli
from learn import split as partition
from learn.checkpoint import ModelCard, read_card
from learn.data.clips import Clip, load_clips
from learn.data.grid import Scales
from learn.settings import preset
from synth.cli import app as synth
from synth.dataset import index, sequence_split
from synth.dataset.dataset_folder import claim
from synth.dataset.sequence_split import DatasetSplit
from synth.errors import UserError
from synth.job.schema import Job
from synth.publish.export.exporter_registry import EXPORTERS, export_dataset

BASE, SCALES = preset("tiny", size=32), Scales(1.0, 0.2, 1.0, 100.0, 0.3)


def make(folder: Path, anatomies: list[int], first: int = 0, opening: list[str] | None = None) -> Path:
    """A dataset of phantoms of these anatomies, or more of one that is there."""
    with claim(folder, Job(sequences=first + len(anatomies)), mix_versions=True) as claimed:
        for k, seed in enumerate(anatomies):
            place = opening and opening[k]
            phantom.write(folder, first + k, anatomy_seed=seed, frames=3, opening=place or None)
        index.write_index(claimed)
    return folder


def divided(*datasets: Path) -> tuple[ModelCard, partition.Split]:
    """The card of a model that would be trained on them, and the parts."""
    clips = [clip for one in datasets for clip in load_clips(one, BASE.grid, ["ideal"])]
    clips, parts = partition.divide(clips, datasets, seed=0)
    named = partition.name_parts(clips, parts)
    return ModelCard(BASE, SCALES, 1.7, *named, [*parts.hashes]), parts


WITH_SIDES = ("hf", "webdataset")
"""Formats that state the side of a sequence beside sequence_split.csv."""


def exported(dataset: Path, target: Path, every: bool) -> dict[str, dict[int, str]]:
    """The side of every sequence by its index, in each export, or in those `WITH_SIDES`."""
    # Phantoms have no camera, no mechanics.
    formats = sorted({*EXPORTERS.names()} - {"endonerf", "vtu"}) if every else WITH_SIDES
    for to in formats:
        export_dataset(dataset, target / to, to)
    tables = [csv.reader((target / to / "split.csv").read_text().splitlines()[1:]) for to in formats]
    files = {one: one.name.split("-")[0] for one in (target / "hf/sequences").iterdir()}
    hf = {k: side for one, side in files.items() for k in pq.read_table(one)["index"].to_pylist()}
    shards = {}
    for one in (target / "webdataset").glob("*.tar"):
        with tarfile.open(one) as archive:
            shards |= {int(name[:6]): one.name.split("-")[0] for name in archive.getnames()}
    listed = {to: {int(k): side for k, side in rows} for to, rows in zip(formats, tables, strict=True)}
    return {f"split.csv of {to}": sides for to, sides in listed.items()} | {"hf": hf, "webdataset": shards}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("draw", "every"),
    [
        (0, True),
        *((k, False) for k in (1, 3)),  # 2 is split as 0
        *(pytest.param(k, True, marks=pytest.mark.trial) for k in (1, 2, 3)),
    ],
)
def test_no_sequence_is_on_two_sides_in_any_artefact(tmp_path: Path, draw: int, every: bool) -> None:
    rng = np.random.default_rng([35, draw])
    own = make(tmp_path / "own", rng.integers(0, 9, 9 + draw).tolist())
    if draw % 2:
        words = ["--shares", "0.5,0.2,0.3", *(["--by", "sequence", "--share-anatomy"] if draw == 3 else [])]
        run(synth, "split", own, *words)
    run(synth, "report", own)
    before = index.read_split(own)
    make(own, rng.integers(0, 14, 4).tolist(), first=len(before.sides))
    run(synth, "report", own)
    stored = index.read_split(own)
    assert before.sides.items() <= stored.sides.items(), "growth changes no side"
    rows = index.read_index(own).to_pylist()
    on = {row["index"]: stored.sides[row["content_hash"]] for row in rows}
    # Publication.
    assert {row["index"]: row["split"] for row in rows} == on
    assert not sequence_split.leaks(rows, stored)
    assert stored.hash in (own / "README.md").read_text()
    for found in exported(own, tmp_path, every).values():
        assert found == on
    # Training.
    card, _ = divided(own)
    assert card.dataset_splits == [stored.hash]
    sides = {part: {stored.sides[name] for name in names} for part, names in card.split.items()}
    assert sides == {"fit": {"train"}, "select": {"validation"}, "test": {"test"}}
    assert sum(map(len, card.split.values())) == len(on)
    clips = load_clips(own, BASE.grid, ["ideal"])
    assert {clip.content_hash for clip in partition.choose_unseen(clips, own, card)} == set(
        card.split["test"]
    )


def test_training_sequences_are_not_scored_whatever_another_split_says(tmp_path: Path) -> None:
    own = make(tmp_path / "own", [*range(9)])
    card, _ = divided(own)
    fitted = card.split["fit"][0]
    sides = dict.fromkeys(index.read_split(own).sides, "train") | {fitted: "test"}
    sequence_split.store(own, DatasetSplit(sides=sides))  # type: ignore[arg-type]
    clips = load_clips(own, BASE.grid, ["ideal"])
    with pytest.raises(UserError):
        partition.choose_unseen(clips, own, card)
    # All sequences of a dataset that is new to the model are scored.
    foreign = make(tmp_path / "foreign", [*range(20, 26)], first=30)
    assert len(partition.choose_unseen(load_clips(foreign, BASE.grid, ["ideal"]), foreign, card)) == 6


def test_several_datasets_keep_their_splits_and_no_brain_is_on_two_sides(tmp_path: Path) -> None:
    for draw in range(2):
        rng = np.random.default_rng([36, draw])
        both = [make(tmp_path / f"{draw}-{k}", rng.permutation(12)[:9].tolist(), 20 * k) for k in range(2)]
        card, _ = divided(*both)
        sides = dict[str, str]()
        for one in both:
            sides |= index.read_split(one).sides
        for part, side in (("fit", "train"), ("select", "validation"), ("test", "test")):
            assert {sides[name] for name in card.split[part]} <= {side}
        on = [set(card.groups[part]) for part in ("fit", "select", "test")]
        assert sum(map(len, on)) == len(set.union(*on))


def test_only_overlapping_openings_are_one_group(tmp_path: Path) -> None:
    at = [(0, 0, 0), (19, 0, 0), (60, 0, 0), (0, 60, 0), (0, 60, 20), (0, 0, 90)]
    names = [f"mesh-5f at {x}, {y}, {z}" for x, y, z in at for _ in range(2)]
    own = make(tmp_path / "own", [1] * 12, opening=names)
    with pytest.raises(UserError):
        divided(own)  # one brain
    run(synth, "split", own, "--by", "opening", "--shares", "0.4,0.3,0.3")
    on = {row["opening"]: set[str]() for row in index.read_index(own).to_pylist()}
    for row in index.read_index(own).to_pylist():
        on[row["opening"]].add(row["split"])
    assert all(len(sides) == 1 for sides in on.values())
    assert on[names[0]] == on[names[2]], "19 mm apart at 12 mm radius"
    assert on[names[6]] == on[names[8]]
    card, _ = divided(own)
    assert partition.find_unit(card) == "opening"
    assert all(card.split[part] for part in ("fit", "select", "test"))


@pytest.mark.slow
def test_train_and_eval_use_the_split(tmp_path: Path) -> None:
    own = make(tmp_path / "own", [*range(8)])
    words = ["--preset", "tiny", "--epochs", "1", "--json", "size=32", "arch.width=8"]
    run(cli.app, "train", own, "-o", tmp_path / "model", *words)
    card, chosen = read_card(tmp_path / "model"), index.read_split(own)
    assert card.dataset_splits == [chosen.hash]
    assert {chosen.sides[name] for name in card.split["test"]} == {"test"}
    done = run(cli.app, "eval", tmp_path / "model", own, "--json")
    assert len(json.loads(done.stdout)["sequences"]) == len(card.split["test"])
    run(cli.app, "train", own, "-o", tmp_path / "b", "folds=3", code=2)


def many(clips: list[Clip], brains: int) -> list[Clip]:
    """Sequences that differ in name alone, two of each brain."""
    names = [(f"{b}-{k}", f"brain-{b}") for b in range(brains) for k in range(2)]
    return [replace(clips[0], content_hash=name, group=brain) for name, brain in names]


def of(brains: Iterable[int]) -> tuple[int, ...]:
    return tuple(2 * b + k for b in brains for k in range(2))


def test_half_of_the_validation_brains_are_moved_to_the_interval_part(clips: list[Clip]) -> None:
    some = many(clips, 40)
    first = partition.Split(of(range(10)), of(range(10, 30)), of(range(30, 40)))
    found = partition.keep_back(some, first, seed=0)
    assert len({some[i].group for i in found.intervals}) == 10
    assert sorted((*found.select, *found.intervals)) == sorted(first.select)
    assert not {some[i].group for i in found.select} & {some[i].group for i in found.intervals}
    assert (found.fit, found.test) == (first.fit, first.test)
    assert partition.keep_back(some, first, seed=0) == found
    assert partition.keep_back(some, first, seed=1) != found
    assert partition.find_obstacle([some[i] for i in found.select], [some[i] for i in found.intervals]) == ""


def test_labels_that_are_the_training_data_are_refused(tmp_path: Path) -> None:
    own = make(tmp_path / "own", [*range(9)])
    clips = load_clips(own, BASE.grid, ["ideal"])
    clips, parts = partition.divide(clips, [own], seed=0)
    with pytest.raises(UserError, match="--labels"):
        partition.add_labels(clips, parts, clips)
    held_back = [clips[k] for k in parts.test]
    others = [replace(one, content_hash=f"other {one.content_hash}") for one in held_back]
    with pytest.raises(UserError, match="--labels"):
        partition.add_labels(clips, parts, others)
    assert partition.add_labels(clips, parts, []) == (clips, parts)


@pytest.mark.slow
def test_labels_join_training_unless_their_brain_is_on_another_side(tmp_path: Path) -> None:
    own, truth = make(tmp_path / "own", [*range(9)]), make(tmp_path / "truth", [*range(12)], first=20)
    words = ["--preset", "tiny", "size=32", "epochs=1", "--input", "mixed", "-o", tmp_path / "m"]
    run(cli.app, "train", own, "--labels", truth, *words)
    card, labels = read_card(tmp_path / "m"), load_clips(truth, BASE.grid, ["ideal"])
    other = {*card.groups["select"], *card.groups["test"]}
    assert {c.content_hash for c in labels if c.group not in other} <= {*card.split["fit"]}
    assert not {c.content_hash for c in labels if c.group in other} & {*card.split["fit"]}
    run(cli.app, "train", own, "--start", tmp_path / "m", *words[:-1], tmp_path / "again")
    assert {*card.split["fit"]} <= {*read_card(tmp_path / "again").split["start"]}
    run(synth, "split", own, "--shares", "0.2,0.6,0.2")
    run(cli.app, "train", own, "--start", tmp_path / "m", *words[:-1], tmp_path / "leak", code=2)
