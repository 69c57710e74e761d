"""Results: every experiment has its page and picture, and they are what its data say."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from typer.testing import CliRunner

from bench.cli import app
from bench.output.charts import Chart, Curve, Panel, bars
from bench.output.result_page import Page, Section
from evidence import pages

RESULTS = Path(__file__).parents[2] / "docs" / "results"
DATA = sorted(
    file.relative_to(RESULTS) for file in RESULTS.rglob("*.json") if not {"runs", "all"} & set(file.parts)
)
TABLES = {"render/stability"}
"""Where there is nothing to draw: cases that held or didn't."""
SHOWN = re.compile(r'!\[[^]]*\]\(([^)]+)\)|<img src="([^"]+)"')
"""A picture in Markdown or in HTML."""


def texts(folder: Path) -> list[str]:
    """The pages in a folder."""
    names = ("README.md", "results.md", "index.html", "figures.html")
    return [(folder / name).read_text("utf-8") for name in names if (folder / name).is_file()]


@pytest.mark.slow
def test_pages_are_those_of_the_data() -> None:
    assert pages.stale(RESULTS) == []


@pytest.mark.parametrize("file", DATA, ids=str)
def test_data_have_a_page_and_a_picture(file: Path) -> None:
    """In their own folder, or in one above that shows several."""
    above = [folder for folder in file.parents if folder != Path()]
    found = {folder: texts(RESULTS / folder) for folder in above}
    assert any(found.values()), file
    drawn = [SHOWN.search(text) for shown in found.values() for text in shown]
    assert TABLES & {str(folder) for folder in above} or any(drawn), file


def test_every_picture_of_a_page_is_there_and_every_picture_is_shown() -> None:
    shown = set()
    for page in [*RESULTS.rglob("*.html"), *RESULTS.rglob("*.md")]:
        for found in SHOWN.finditer(page.read_text("utf-8")):
            file = (page.parent / (found[1] or found[2])).resolve()
            assert file.is_file(), f"{page} shows {file}"
            shown.add(file)
    drawn = {file.resolve() for file in RESULTS.rglob("*.svg")}
    assert drawn
    assert drawn <= shown


def test_no_page_is_hidden_by_a_readme() -> None:
    """Of README.md and index.html in one folder the site shows one."""
    assert not [page for page in RESULTS.rglob("index.html") if page.with_name("README.md").is_file()]


@pytest.mark.parametrize("page", sorted(RESULTS.rglob("*.html")), ids=lambda p: str(p.relative_to(RESULTS)))
def test_a_page_has_its_data(page: Path) -> None:
    # `all` gathers what the other rooms have.
    assert "all" in page.relative_to(RESULTS).parts or any(page.parent.rglob("*.json"))


@pytest.mark.parametrize("folder", sorted({Path(file.parts[0]) for file in DATA}), ids=str)
def test_a_room_names_command_and_machine(folder: Path) -> None:
    below = [place for place in (RESULTS / folder).rglob("*") if place.is_dir()]
    whole = "\n".join(text for place in (RESULTS / folder, *below) for text in texts(place))
    assert "bench " in whole or "run.sh" in whole
    assert "cores" in whole


def test_a_page_that_is_not_of_its_data_is_found(tmp_path: Path) -> None:
    folder = tmp_path / "pipeline" / "stages"
    folder.mkdir(parents=True)
    cost = {"render": {"median": 0.3, "largest": 0.4}}
    (folder / "stages.json").write_text(json.dumps({"cpu_s_a_frame": cost, "peak_rss_mb": 900.0}))
    ran = CliRunner().invoke(app, ["pages", str(tmp_path)])
    assert ran.exit_code == 0
    assert "0.3" in (tmp_path / "pipeline" / "figures.html").read_text()
    assert pages.stale(tmp_path) == []
    cost["render"]["median"] = 0.35
    (folder / "stages.json").write_text(json.dumps({"cpu_s_a_frame": cost, "peak_rss_mb": 900.0}))
    ran = CliRunner().invoke(app, ["pages", str(tmp_path), "--check"])
    assert ran.exit_code == 1
    assert ran.output.count("\n") == 2  # picture and page
    (tmp_path / "pipeline" / "chart.svg").unlink()
    assert CliRunner().invoke(app, ["pages", str(tmp_path)]).output.count("\n") == 2
    assert pages.stale(tmp_path) == []


ROWS = [{"law": "<linear>", "error": 0.0123456}, {"law": "stable", "error": None, "why": "a | b"}]
PANEL = Panel(
    "cost", "ms", "error [%]", (Curve("P2 <fast>", (1.0, 10.0), (4.0, float("nan")), ("700", "1600")),)
)
CHART = Chart("error", "mN", bars({"ours": 1.0, "theirs": 2.0}, {"ours": (0.5, 1.5)}))


def test_a_page_says_what_made_it_and_holds_its_rows_in_both_forms() -> None:
    found = {"command": "bench pareto fem; bench again", "machine": {"cores": 2}, "seed": 7}
    for name in ("index.html", "README.md"):
        page = Page("Room", found, [CHART, PANEL], [Section("All", ROWS, ["Read *this*."])], name=name)
        text = page.files()[name]
        assert page.commands == ["bench pareto fem", "bench again"]
        for said in ("bench pareto fem", "cores 2", "Seed 7", "All", "0.01235", "chart.svg", "intervals.svg"):
            assert said in text, said
    assert "| stable | – | a \\| b |" in text
    html = replace(page, name="index.html").files()["index.html"]
    assert "<td>&lt;linear&gt;</td>" in html
    assert "Read <em>this</em>." in html


def test_a_page_opens_without_a_net() -> None:
    html = Page("Room", {}, [PANEL]).files()["index.html"]
    assert re.findall(r"(?:src|href)=\"([^\"]+)", html) == ["chart.svg"]


def test_charts_say_their_names_units_and_values() -> None:
    files = Page("Room", {}, [PANEL, CHART]).files()
    curves, intervals = (
        set(ElementTree.fromstring(files[n]).itertext()) for n in ("chart.svg", "intervals.svg")
    )
    assert {"cost", "ms", "error [%]", "P2 <fast>"} <= curves
    assert {"error", "mN", "ours", "theirs", "1 [0.5, 1.5]", "2"} <= intervals


def test_charts_of_the_same_rows_stand_side_by_side() -> None:
    both = ElementTree.fromstring(Page("Room", {}, [CHART, CHART]).files()["chart.svg"])
    alone = ElementTree.fromstring(Page("Room", {}, [CHART]).files()["chart.svg"])
    assert both.get("viewBox") == alone.get("viewBox")
    assert list(both.itertext()).count("theirs") == 1


def test_single_values_of_a_result() -> None:
    found = {"a": 1, "b": {"c": 2, "d": [1, 2]}, "machine": {"cores": 2}}
    assert pages.flat(found) == [{"what": "a", "value": 1}, {"what": "b: c", "value": 2}]
