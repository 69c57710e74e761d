"""Results: every experiment has its page and picture, and they are what its data say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bench.cli import app
from bench.output import result_page
from bench.output.result_page import Chart, Sheet
from evidence import catalogue as pages
from evidence.tune import experiment

RESULTS = Path(__file__).parents[2] / "docs" / "results"
DATA = sorted(
    file.relative_to(RESULTS) for file in RESULTS.rglob("*.json") if not {"runs", "all"} & set(file.parts)
)
TABLES = {"render/stability"}
"""Where there is nothing to draw: cases that held or didn't."""


def test_pages_are_those_of_the_data() -> None:
    assert pages.stale(RESULTS) == []


@pytest.mark.parametrize("file", DATA, ids=str)
def test_data_have_a_page_and_a_picture(file: Path) -> None:
    """In their own folder, or in one above that shows several."""
    above = [RESULTS / folder for folder in file.parents if folder != Path()]
    pages = [p.read_text("utf-8") for folder in above for p in folder.glob("index.html")]
    assert pages, file
    assert TABLES & {str(folder) for folder in file.parents} or any("<svg" in page for page in pages), file


@pytest.mark.parametrize(
    "page", sorted(RESULTS.rglob("index.html")), ids=lambda p: str(p.relative_to(RESULTS))
)
def test_a_page_has_its_data(page: Path) -> None:
    # `all` gathers what the other rooms have.
    assert "all" in page.relative_to(RESULTS).parts or any(page.parent.rglob("*.json"))


def test_tuning_says_what_its_data_say() -> None:
    folder = RESULTS / "tune"
    assert (folder / "README.md").read_text("utf-8") == experiment.readme(experiment.read(folder))


@pytest.mark.parametrize("folder", sorted({Path(file.parts[0]) for file in DATA}), ids=str)
def test_a_room_names_command_and_machine(folder: Path) -> None:
    texts = [p.read_text("utf-8") for p in (RESULTS / folder).rglob("README.md")]
    whole = "\n".join([*texts, *(p.read_text("utf-8") for p in (RESULTS / folder).rglob("index.html"))])
    assert "bench " in whole or "run.sh" in whole
    assert "cores" in whole


def test_a_page_that_is_not_of_its_data_is_found(tmp_path: Path) -> None:
    folder = tmp_path / "pipeline" / "stages"
    folder.mkdir(parents=True)
    cost = {"render": {"median": 0.3, "largest": 0.4}}
    (folder / "stages.json").write_text(json.dumps({"cpu_s_a_frame": cost, "peak_rss_mb": 900.0}))
    ran = CliRunner().invoke(app, ["pages", str(tmp_path)])
    assert ran.exit_code == 0
    assert "0.3" in (tmp_path / "pipeline" / "index.html").read_text()
    assert pages.stale(tmp_path) == []
    cost["render"]["median"] = 0.35
    (folder / "stages.json").write_text(json.dumps({"cpu_s_a_frame": cost, "peak_rss_mb": 900.0}))
    ran = CliRunner().invoke(app, ["pages", str(tmp_path), "--check"])
    assert ran.exit_code == 1
    assert ran.output.count("\n") == 2  # picture and page


def test_drawings_one_below_the_other() -> None:
    chart = Chart("error", "mN", result_page.bars({"ours": 1.0, "theirs": 2.0}))
    both = result_page.together([chart.drawing(), chart.drawing()])
    tall = float(both.split('viewBox="0 0 ')[1].split()[1].strip('"'))
    alone = float(chart.drawing().split('viewBox="0 0 ')[1].split()[1].rstrip('">').split('"')[0])
    assert tall == 2 * alone
    assert both.count("theirs: 2") == 2


def test_a_sheet_says_command_seed_and_table() -> None:
    rows = [{"method": "ours", "error": 1.5}]
    page = Sheet("Room", "bench experiment room", {"seed": 7}, (), (("All", rows),)).files()["index.html"]
    assert "bench experiment room" in page
    assert "seed 7" in page
    assert "1.5" in page


def test_single_values_of_a_result() -> None:
    found = {"a": 1, "b": {"c": 2, "d": [1, 2]}, "machine": {"cores": 2}}
    assert result_page.flat(found) == [{"what": "a", "value": 1}, {"what": "b: c", "value": 2}]
