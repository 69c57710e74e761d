"""Format versions: the current and the previous one are read; older and newer ones are refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from synth.dataset.folder import Folder
from synth.errors import UserError
from synth.formats import FIRST, FOLDER, check_format


def test_a_reader_accepts_its_format_and_the_previous_but_none_before_the_first() -> None:
    newest = FIRST + 2
    for found in (newest, newest - 1):
        check_format(found, newest, "x")
    for found, current in ((newest - 2, newest), (newest + 1, newest), (FIRST - 1, FIRST), (None, FIRST)):
        with pytest.raises(UserError, match=f"written by format {found}; this version reads {current}"):
            check_format(found, current, "x")


def test_a_dataset_without_a_format_version_is_refused(tmp_path: Path) -> None:
    before = {"identity": "", "job": {"fem": {"tip": "flat"}}, "generators": []}
    (tmp_path / "dataset.json").write_text(json.dumps(before))
    with pytest.raises(UserError, match=f"written by format 1; this version reads {FOLDER}"):
        Folder(tmp_path).job()
