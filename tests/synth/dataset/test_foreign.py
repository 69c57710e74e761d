"""Datasets of other programs and versions: read in a known format, or refused."""

import json
from pathlib import Path

import pytest

from synth.dataset.dataset_folder import Folder
from synth.errors import UserError
from synth.formats import FIRST, FOLDER, check_format
from synth.job.reader import parse_job


def test_a_dataset_is_read_without_the_plug_ins_that_made_it(tmp_path: Path) -> None:
    job = {"flow": {"backend": "gone"}, "fem": {"law": "gone"}}
    described = {"format_version": FOLDER, "identity": "", "job": job, "generators": []}
    (tmp_path / "dataset.json").write_text(json.dumps(described))
    read = Folder(tmp_path).job()
    assert (read.flow.backend, read.fem.law) == ("gone", "gone")
    with pytest.raises(UserError, match=r"flow\.backend"):
        parse_job(json.dumps(job), "job.yaml", tmp_path)
    before = {"render": {"scenery": ["cottonoid", "bone"], "size": [320, 240]}, "sensor": {"blur_px": 0.5}}
    (tmp_path / "dataset.json").write_text(json.dumps(described | {"format_version": 3, "job": before}))
    read = Folder(tmp_path).job()
    assert (read.render.scenery, read.sensor.blur_px) == (("bone",), (1.0, 1.0))
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
