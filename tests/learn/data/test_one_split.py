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
    with claim(folder, Job(sequences=first + len(anatomies)), mix_versions=True) as claimed_folder:
        for k, seed in enumerate(anatomies):
            place = opening and opening[k]
            phantom.write(folder, first + k, anatomy_seed=seed, frames=3, opening=place or None)
        index.write_index(claimed_folder)
    return folder


def divide_datasets(*datasets: Path) -> tuple[ModelCard, partition.Split]:
    """The card of a model that would be trained on them, and the parts."""
    clips = [clip for dataset in datasets for clip in load_clips(dataset, BASE.grid, ["ideal"])]
    clips, parts = partition.divide(clips, datasets, seed=0)
    part_names = partition.name_parts(clips, parts)
    return ModelCard(BASE, SCALES, 1.7, *part_names, [*parts.hashes]), parts


WITH_SIDES = ("hf", "webdataset")
"""Formats that state the side of a sequence beside sequence_split.csv."""


def export_sides(dataset: Path, target: Path, all_formats: bool) -> dict[str, dict[int, str]]:
    """The side of every sequence by its index, in each export, or in those `WITH_SIDES`."""
    # Phantoms have no camera, no mechanics.
    formats = sorted({*EXPORTERS.names()} - {"endonerf", "vtu"}) if all_formats else WITH_SIDES
    for form in formats:
        export_dataset(dataset, target / form, form)
    tables = [csv.reader((target / form / "split.csv").read_text().splitlines()[1:]) for form in formats]
    files = {path: path.name.split("-")[0] for path in (target / "hf/sequences").iterdir()}
    hf = {k: side for path, side in files.items() for k in pq.read_table(path)["index"].to_pylist()}
    shards = {}
    for shard in (target / "webdataset").glob("*.tar"):
        with tarfile.open(shard) as archive:
            shards |= {int(name[:6]): shard.name.split("-")[0] for name in archive.getnames()}
    sides_by_form = {
        form: {int(k): side for k, side in rows} for form, rows in zip(formats, tables, strict=True)
    }
    return {f"split.csv of {form}": sides for form, sides in sides_by_form.items()} | {
        "hf": hf,
        "webdataset": shards,
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("draw", "all_formats"),
    [
        (0, True),
        *((k, False) for k in (1, 3)),  # 2 is split as 0
        *(pytest.param(k, True, marks=pytest.mark.trial) for k in (1, 2, 3)),
    ],
)
def test_no_sequence_is_on_two_sides_in_any_artefact(tmp_path: Path, draw: int, all_formats: bool) -> None:
    rng = np.random.default_rng([35, draw])
    dataset = make(tmp_path / "own", rng.integers(0, 9, 9 + draw).tolist())
    if draw % 2:
        words = ["--shares", "0.5,0.2,0.3", *(["--by", "sequence", "--share-anatomy"] if draw == 3 else [])]
        run(synth, "split", dataset, *words)
    run(synth, "report", dataset)
    before = index.read_split(dataset)
    make(dataset, rng.integers(0, 14, 4).tolist(), first=len(before.sides))
    run(synth, "report", dataset)
    stored_split = index.read_split(dataset)
    assert before.sides.items() <= stored_split.sides.items(), "growth changes no side"
    rows = index.read_index(dataset).to_pylist()
    expected = {row["index"]: stored_split.sides[row["content_hash"]] for row in rows}
    # Publication.
    assert {row["index"]: row["split"] for row in rows} == expected
    assert not sequence_split.find_leaks(rows, stored_split)
    assert stored_split.hash in (dataset / "README.md").read_text()
    for export in export_sides(dataset, tmp_path, all_formats).values():
        assert export == expected
    # Training.
    card, _ = divide_datasets(dataset)
    assert card.dataset_splits == [stored_split.hash]
    sides = {part: {stored_split.sides[name] for name in names} for part, names in card.split.items()}
    assert sides == {"fit": {"train"}, "select": {"validation"}, "test": {"test"}}
    assert sum(map(len, card.split.values())) == len(expected)
    clips = load_clips(dataset, BASE.grid, ["ideal"])
    assert {clip.content_hash for clip in partition.choose_unseen(clips, dataset, card)} == set(
        card.split["test"]
    )


def test_training_sequences_are_not_scored_whatever_another_split_says(tmp_path: Path) -> None:
    dataset = make(tmp_path / "own", [*range(9)])
    card, _ = divide_datasets(dataset)
    fitted_hash = card.split["fit"][0]
    sides = dict.fromkeys(index.read_split(dataset).sides, "train") | {fitted_hash: "test"}
    sequence_split.store(dataset, DatasetSplit(sides=sides))  # type: ignore[arg-type]
    clips = load_clips(dataset, BASE.grid, ["ideal"])
    with pytest.raises(UserError):
        partition.choose_unseen(clips, dataset, card)
    # All sequences of a dataset that is new to the model are scored.
    foreign = make(tmp_path / "foreign", [*range(20, 26)], first=30)
    assert len(partition.choose_unseen(load_clips(foreign, BASE.grid, ["ideal"]), foreign, card)) == 6


def test_several_datasets_keep_their_splits_and_no_brain_is_on_two_sides(tmp_path: Path) -> None:
    for draw in range(2):
        rng = np.random.default_rng([36, draw])
        datasets = [
            make(tmp_path / f"{draw}-{k}", rng.permutation(12)[:9].tolist(), 20 * k) for k in range(2)
        ]
        card, _ = divide_datasets(*datasets)
        sides = dict[str, str]()
        for dataset in datasets:
            sides |= index.read_split(dataset).sides
        for part, side in (("fit", "train"), ("select", "validation"), ("test", "test")):
            assert {sides[name] for name in card.split[part]} <= {side}
        groups = [set(card.groups[part]) for part in ("fit", "select", "test")]
        assert sum(map(len, groups)) == len(set.union(*groups))


def test_only_overlapping_openings_are_one_group(tmp_path: Path) -> None:
    centres = [(0, 0, 0), (19, 0, 0), (60, 0, 0), (0, 60, 0), (0, 60, 20), (0, 0, 90)]
    names = [f"mesh-5f at {x}, {y}, {z}" for x, y, z in centres for _ in range(2)]
    dataset = make(tmp_path / "own", [1] * 12, opening=names)
    with pytest.raises(UserError):
        divide_datasets(dataset)  # one brain
    run(synth, "split", dataset, "--by", "opening", "--shares", "0.4,0.3,0.3")
    opening_sides = {row["opening"]: set[str]() for row in index.read_index(dataset).to_pylist()}
    for row in index.read_index(dataset).to_pylist():
        opening_sides[row["opening"]].add(row["split"])
    assert all(len(sides) == 1 for sides in opening_sides.values())
    assert opening_sides[names[0]] == opening_sides[names[2]], "19 mm apart at 12 mm radius"
    assert opening_sides[names[6]] == opening_sides[names[8]]
    card, _ = divide_datasets(dataset)
    assert partition.find_unit(card) == "opening"
    assert all(card.split[part] for part in ("fit", "select", "test"))


@pytest.mark.slow
def test_train_and_eval_use_the_split(tmp_path: Path) -> None:
    dataset = make(tmp_path / "own", [*range(8)])
    words = ["--preset", "tiny", "--epochs", "1", "--json", "size=32", "arch.width=8"]
    run(cli.app, "train", dataset, "-o", tmp_path / "model", *words)
    card, split = read_card(tmp_path / "model"), index.read_split(dataset)
    assert card.dataset_splits == [split.hash]
    assert {split.sides[name] for name in card.split["test"]} == {"test"}
    result = run(cli.app, "eval", tmp_path / "model", dataset, "--json")
    assert len(json.loads(result.stdout)["sequences"]) == len(card.split["test"])
    run(cli.app, "train", dataset, "-o", tmp_path / "b", "folds=3", code=2)


def make_sequences(clips: list[Clip], brains: int) -> list[Clip]:
    """Sequences that differ in name alone, two of each brain."""
    names = [(f"{b}-{k}", f"brain-{b}") for b in range(brains) for k in range(2)]
    return [replace(clips[0], content_hash=name, group=brain) for name, brain in names]


def list_indices(brains: Iterable[int]) -> tuple[int, ...]:
    return tuple(2 * b + k for b in brains for k in range(2))


def test_half_of_the_validation_brains_are_moved_to_the_interval_part(clips: list[Clip]) -> None:
    sequences = make_sequences(clips, 40)
    first = partition.Split(list_indices(range(10)), list_indices(range(10, 30)), list_indices(range(30, 40)))
    split = partition.keep_back(sequences, first, seed=0)
    assert len({sequences[i].group for i in split.intervals}) == 10
    assert sorted((*split.select, *split.intervals)) == sorted(first.select)
    assert not {sequences[i].group for i in split.select} & {sequences[i].group for i in split.intervals}
    assert (split.fit, split.test) == (first.fit, first.test)
    assert partition.keep_back(sequences, first, seed=0) == split
    assert partition.keep_back(sequences, first, seed=1) != split
    assert (
        partition.find_obstacle([sequences[i] for i in split.select], [sequences[i] for i in split.intervals])
        == ""
    )


def test_labels_that_are_the_training_data_are_refused(tmp_path: Path) -> None:
    dataset = make(tmp_path / "own", [*range(9)])
    clips = load_clips(dataset, BASE.grid, ["ideal"])
    clips, parts = partition.divide(clips, [dataset], seed=0)
    with pytest.raises(UserError, match="--labels"):
        partition.add_labels(clips, parts, clips)
    held_back = [clips[k] for k in parts.test]
    others = [replace(clip, content_hash=f"other {clip.content_hash}") for clip in held_back]
    with pytest.raises(UserError, match="--labels"):
        partition.add_labels(clips, parts, others)
    assert partition.add_labels(clips, parts, []) == (clips, parts)


@pytest.mark.slow
def test_labels_join_training_unless_their_brain_is_on_another_side(tmp_path: Path) -> None:
    dataset, truth = make(tmp_path / "own", [*range(9)]), make(tmp_path / "truth", [*range(12)], first=20)
    words = ["--preset", "tiny", "size=32", "epochs=1", "--input", "mixed", "-o", tmp_path / "m"]
    run(cli.app, "train", dataset, "--labels", truth, *words)
    card, labels = read_card(tmp_path / "m"), load_clips(truth, BASE.grid, ["ideal"])
    other = {*card.groups["select"], *card.groups["test"]}
    assert {c.content_hash for c in labels if c.group not in other} <= {*card.split["fit"]}
    assert not {c.content_hash for c in labels if c.group in other} & {*card.split["fit"]}
    run(cli.app, "train", dataset, "--start", tmp_path / "m", *words[:-1], tmp_path / "again")
    assert {*card.split["fit"]} <= {*read_card(tmp_path / "again").split["start"]}
    run(synth, "split", dataset, "--shares", "0.2,0.6,0.2")
    run(cli.app, "train", dataset, "--start", tmp_path / "m", *words[:-1], tmp_path / "leak", code=2)
