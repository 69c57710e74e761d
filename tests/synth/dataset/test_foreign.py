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
    manifest = {"format_version": FOLDER, "identity": "", "job": job, "generators": []}
    (tmp_path / "dataset.json").write_text(json.dumps(manifest))
    stored_job = Folder(tmp_path).job()
    assert (stored_job.flow.backend, stored_job.fem.law) == ("gone", "gone")
    with pytest.raises(UserError, match=r"flow\.backend"):
        parse_job(json.dumps(job), "job.yaml", tmp_path)
    old_job = {"render": {"scenery": ["cottonoid", "bone"], "size": [320, 240]}, "sensor": {"blur_px": 0.5}}
    (tmp_path / "dataset.json").write_text(json.dumps(manifest | {"format_version": 3, "job": old_job}))
    stored_job = Folder(tmp_path).job()
    assert (stored_job.render.scenery, stored_job.sensor.blur_px) == (("bone",), (1.0, 1.0))
    manifest.pop("format_version")
    (tmp_path / "dataset.json").write_text(json.dumps(manifest))
    with pytest.raises(UserError, match="format"):
        Folder(tmp_path).job()


def test_a_reader_accepts_its_format_and_the_previous_but_none_before_the_first() -> None:
    latest_version = FIRST + 2
    for version in (latest_version, latest_version - 1):
        check_format(version, latest_version, "x")
    for version, reader_version in (
        (latest_version - 2, latest_version),
        (latest_version + 1, latest_version),
        (FIRST - 1, FIRST),
        (None, FIRST),
    ):
        with pytest.raises(
            UserError, match=f"written by format {version}; this version reads {reader_version}"
        ):
            check_format(version, reader_version, "x")
