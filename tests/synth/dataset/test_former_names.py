"""Stores with a field under its former name are read as those of today, wherever it is read by name."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import fake_work
import former_name
import numpy as np
import pytest
import zarr
from fake_run import in_process

from synth.checks import verify
from synth.dataset import field_sizes
from synth.dataset.folder import Folder
from synth.dataset.index import write_index
from synth.dataset.store import Dataset, open_sequence
from synth.dataset.torch_dataset import Frames
from synth.errors import UserError
from synth.fields import FIELDS, FORMER_NAMES
from synth.job.schema import Job
from synth.publish import card
from synth.publish.export import formats

JOB = Job(seed=3, sequences=2, frames=4, render={"size": (48, 40)}, store={"flow": "float16"})
"""With recovered flow: the default's estimator is tvl1."""


@pytest.fixture(scope="module")
def today(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("today") / "out"
    in_process(JOB, root, fake_work.consistent)
    return root


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("older") / "out"
    in_process(JOB, root, fake_work.consistent)
    for index in range(JOB.sequences):
        former_name.rename_field(root / f"{index:06d}.zarr")
    (root / "index.parquet").unlink()
    write_index(Folder(root))
    card.write_card(Folder(root))
    return root


def test_former_names_lead_to_fields_and_are_none() -> None:
    assert set(FORMER_NAMES.values()) <= set(FIELDS)
    assert not set(FORMER_NAMES) & set(FIELDS)


@pytest.mark.slow
def test_it_is_read_by_the_name_of_today_and_by_its_own(today: Path, older: Path) -> None:
    now, then = open_sequence(today / "000001.zarr"), open_sequence(older / "000001.zarr")
    assert "flow_tvl1" in zarr.open_group(str(then.path), mode="r")
    assert then.fields == now.fields
    for sequence in (now, then):
        for name in ("flow_recovered", "flow_tvl1"):
            assert name in sequence
            assert np.array_equal(sequence[name][2], now["flow_recovered"][2])
            assert np.array_equal(sequence[name][:], now["flow_recovered"][:])


def test_its_seal_and_checksums_hold(older: Path) -> None:
    report = verify.verify_dataset(older)
    assert report.good, [check.failures for check in report.checks]


def test_damage_in_it_is_found(older: Path, tmp_path: Path) -> None:
    root = tmp_path / "out"
    shutil.copytree(older, root)
    array = zarr.open_group(str(root / "000000.zarr"), mode="r+")["flow_tvl1"]
    assert isinstance(array, zarr.Array)
    array[1, 5, 5, 0] += 1
    failing = {check.name for check in verify.verify_dataset(root).checks if not check.good}
    assert failing == {"checksum"}
    shutil.rmtree(root / "000000.zarr/flow_tvl1/c")
    with pytest.raises(UserError, match="flow_recovered: file c/0/0/0/0 is missing"):
        open_sequence(root / "000000.zarr")["flow_recovered"]


def test_frames_sizes_exports_and_card_take_it(today: Path, older: Path, tmp_path: Path) -> None:
    for name in ("flow_recovered", "flow_tvl1"):
        assert np.array_equal(Frames(older, [name])[5][name], Frames(today, [name])[5][name])
    sizes = {row.name: row.measured for row in field_sizes.rows((40, 48), Dataset(older)[0])}
    assert (sizes["flow_recovered"] or 0) > 0
    formats.export_dataset(older, tmp_path / "to", "folder")
    assert (tmp_path / "to/000000/flow_recovered.npy").is_file()
    assert "`flow_recovered`" in (older / "README.md").read_text()


def test_nothing_is_written_under_a_former_name(tmp_path: Path) -> None:
    fake_work.consistent(JOB, 0, tmp_path, lambda *_: None)
    hashes = json.loads((tmp_path / "000000.zarr/zarr.json").read_text())["attributes"]["field_hashes"]
    assert "flow_recovered" in hashes
    assert not set(FORMER_NAMES) & set(hashes)
    assert not any((tmp_path / "000000.zarr" / name).exists() for name in FORMER_NAMES)
