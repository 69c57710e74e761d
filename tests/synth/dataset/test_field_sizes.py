"""The table of fields: the page in the docs is the one that the program writes, sizes are those on disk."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fake_work import sequence
from typer.testing import CliRunner

from synth.cli import app
from synth.dataset import field_sizes
from synth.fields import FIELDS
from synth.job.schema import Job

PAGE = Path(__file__).resolve().parents[3] / "docs/fields.md"


def test_the_page_is_up_to_date() -> None:
    assert PAGE.read_text("utf-8") == field_sizes.page(), "run: synth fields --page > docs/fields.md"


def test_sizes_are_those_of_the_dataset(tmp_path: Path) -> None:
    job = Job(frames=3, render={"size": (40, 30)}, flow={"backend": "ideal"})
    sequence(job, 0, tmp_path, lambda *_: None)
    made = CliRunner().invoke(app, ["fields", str(tmp_path), "--json"])
    rows = {row["name"]: row for row in json.loads(made.stdout)}
    assert list(rows) == list(FIELDS)
    files = [path for path in (tmp_path / "000000.zarr/flow").rglob("*") if path.is_file()]
    assert rows["flow"]["measured"] == pytest.approx(sum(path.stat().st_size for path in files) / 3)
    assert rows["flow"]["raw"] == 40 * 30 * 2 * 4
    assert rows["flow_recovered"]["measured"] == 0.0


@pytest.mark.parametrize("size", ["640", "x480", "0x4", "axb"])
def test_a_size_that_is_none_is_one_line(size: str) -> None:
    made = CliRunner().invoke(app, ["fields", "--size", size])
    assert made.exit_code == 2
    assert "is not WIDTHxHEIGHT" in made.output
