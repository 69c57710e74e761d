"""Untrusted datasets: read unchanged since the seal and in a known format, or refused."""

import json
import shutil
from pathlib import Path
from typing import Any

import fake_work
import foreign
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command import run
from fake_run import in_process

from synth.checks import verify
from synth.cli import app
from synth.dataset import index, split
from synth.dataset.folder import Folder, claim
from synth.dataset.store import open_sequence
from synth.errors import UserError
from synth.formats import FIRST, FOLDER, check_format
from synth.job.reader import parse_job
from synth.job.schema import Job
from synth.publish.export.registry import export_dataset

JOB = Job(seed=1, sequences=3, frames=3, render={"size": (64, 48)}, flow={"backend": "ideal"})
SEQUENCE = "000000.zarr"


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pristine") / "out"
    in_process(JOB, root, fake_work.sequence)
    return root


@pytest.fixture
def dataset(pristine: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine, tmp_path / "out"))


def bad(dataset: Path) -> set[str]:
    """Names of the checks that fail."""
    return {check.name for check in verify.verify_dataset(dataset).checks if check.bad}


@pytest.mark.parametrize(
    "changes",
    [{"young_kpa": np.nan}, {"frames": 10**9}, {"scenario": {"gestures": "pull"}}, {"format_version": 1}],
)
def test_invalid_attributes_are_refused_though_sealed(dataset: Path, changes: dict[str, Any]) -> None:
    foreign.edit_attributes(dataset / SEQUENCE, **changes)
    with pytest.raises(UserError):
        open_sequence(dataset / SEQUENCE)
    assert "readable" in bad(dataset)


def test_edited_attributes_and_sides_are_refused_and_found(dataset: Path) -> None:
    run(app, "split", dataset, "--by", "sequence")
    assert "splits" not in bad(dataset)
    found = index.read_index(dataset).to_pylist()
    next(row for row in found if row["split"] == "test")["split"] = "train"
    index.save_rows(dataset, found)
    foreign.edit_attributes(dataset / SEQUENCE, reseal=False, young_kpa=2.0)
    assert {"splits", "seal"} <= bad(dataset)
    with pytest.raises(UserError):
        export_dataset(dataset, dataset / "to", "folder")


@pytest.mark.parametrize("text", ['{"by": 7}', "\x00"])
def test_an_index_of_another_program_and_a_damaged_split_are_refused(dataset: Path, text: str) -> None:
    pq.write_table(pa.table({"a": [1]}), dataset / "index.parquet")
    with pytest.raises(UserError):
        index.read_index(dataset)
    assert "dataset" in bad(dataset)
    (dataset / "split.json").write_text(text)
    with pytest.raises(UserError, match="split"):
        split.read_stored(dataset)


def test_no_run_follows_a_link(dataset: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "precious").mkdir(parents=True)
    shutil.rmtree(dataset / ".run/scratch")
    (dataset / ".run/scratch").symlink_to(elsewhere)
    with pytest.raises(UserError), claim(dataset, JOB):
        pass
    assert (elsewhere / "precious").is_dir()


def test_a_dataset_is_read_without_the_plug_ins_that_made_it(tmp_path: Path) -> None:
    job = {"flow": {"backend": "gone"}, "fem": {"law": "gone"}}
    described = {"format_version": FOLDER, "identity": "", "job": job, "generators": []}
    (tmp_path / "dataset.json").write_text(json.dumps(described))
    read = Folder(tmp_path).job()
    assert (read.flow.backend, read.fem.law) == ("gone", "gone")
    with pytest.raises(UserError, match=r"flow\.backend"):
        parse_job(json.dumps(job), "job.yaml", tmp_path)
    before = {"appearance": {"cottonoid": 0.5}, "render": {"tool": False}, "fem": {}}
    (tmp_path / "dataset.json").write_text(json.dumps(described | {"format_version": 2, "job": before}))
    assert Folder(tmp_path).job().fem.instrument == ("none",)
    described.pop("format_version")
    (tmp_path / "dataset.json").write_text(json.dumps(described))
    with pytest.raises(UserError, match="format"):
        Folder(tmp_path).job()


def test_a_reader_accepts_its_format_and_the_previous_but_none_before_the_first() -> None:
    newest = FIRST + 2
    for found in (newest, newest - 1):
        check_format(found, newest, "x")
    for found, current in ((newest - 2, newest), (newest + 1, newest), (FIRST - 1, FIRST), (None, FIRST)):
        with pytest.raises(UserError, match=f"written by format {found}; this version reads {current}"):
            check_format(found, current, "x")
