"""Stored results: their provenance and charts, whether they are up to date, making all of them again."""

import json
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from evidence import all as everything
from evidence import report, result_status, study
from evidence.all import run_steps
from evidence.guard import guard
from evidence.learn import shipped
from evidence.report import Page
from learn.inference.shipped_networks import MODELS, NAMES

CHART = report.intervals("error", "mN", {"ours": (1.0, 0.5, 2.0), "<theirs>": (2.0,)})
ROWS = [{"law": "<linear>", "error": 0.0123456}, {"law": "stable", "error": None, "why": "a | b"}]


def test_data_are_stored_with_their_provenance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["x", "/some/where.csv", "--cache=/a/b", "-o", "/tmp/o", "--seeds", "3"])
    report.save(
        tmp_path,
        "found.json",
        {"third": 1 / 3, "rows": ROWS},
        lambda document: Page("Title", document, chart=CHART),
    )
    document = json.loads((tmp_path / "found.json").read_text())
    assert list(document) == ["command", "commit", "date", "machine", "cpu_hours", "third", "rows"]
    assert document["command"].endswith("where.csv --cache=b --seeds 3")
    assert document["third"] == 0.333333
    updated = document | {"commit": "1234567"}
    report.save(tmp_path, "found.json", updated)
    assert json.loads((tmp_path / "found.json").read_text()) == updated
    text = " ".join(ElementTree.fromstring((tmp_path / "chart.svg").read_text()).itertext())
    assert all(value in text for value in ("mN", "ours", "<theirs>"))


def test_pareto_front() -> None:
    assert report.front([(2.0, 1.0), (1.0, 3.0), (3.0, 2.0), (1.0, 2.0)]) == [3, 0]


POOLED = "foreign.recordings", "scoring.exvivo"  # their pages are of `bench pool`
DRAWN = [name for name in study.names() if name not in POOLED]


@pytest.mark.parametrize("name", DRAWN)
def test_the_page_of_a_study_is_drawn_from_its_stored_data(name: str, tmp_path: Path) -> None:
    entry = study.load(name)
    if entry.page is None:
        assert not entry.result
        return
    document = json.loads((report.RESULTS / entry.result).read_text("utf-8"))
    entry.page(document).write(tmp_path)
    assert (tmp_path / "README.md").read_text("utf-8").startswith("# ")


@pytest.mark.parametrize("name", NAMES)
def test_figures_of_a_network_card_are_those_of_the_stored_result(name: str) -> None:
    rows = json.loads((report.RESULTS / "learn/shipped/shipped.json").read_text("utf-8"))["rows"]
    page = (MODELS / name / "README.md").read_text("utf-8")
    figures_by_name = shipped.list_figures([row for row in rows if row["model"] == name])
    assert len(figures_by_name) == 2
    assert all(f"| {label} | {figures} |\n" in page for label, figures in figures_by_name.items())


def test_what_other_programs_write_is_stamped_with_the_probes_it_needs(tmp_path: Path) -> None:
    file = tmp_path / "pool.json"
    file.write_text('{"error": 0.1}')
    (before,) = result_status.gather(tmp_path)
    result_status.stamp_files([file], ("score", "mesh"))
    (after,) = result_status.gather(tmp_path)
    assert (before.stands, after.stands) == (False, True)
    assert (after.needs, after.commit) == (("score", "mesh"), report.commit())
    assert json.loads(file.read_text("utf-8"))["error"] == 0.1


def test_every_stored_result_has_its_study() -> None:
    results = [study.load(name).result for name in study.names()]
    files = [{*report.RESULTS.glob(result)} for result in results if result]
    assert all(files)
    assert set.union(*files) == {*report.RESULTS.rglob("*.json")} - {guard.FILE}
    assert sum(map(len, files)) == len(set.union(*files))


def test_every_study_accepts_the_arguments_of_its_steps(tmp_path: Path) -> None:
    options = dict.fromkeys(("photo", "mechanics_python", "pictures_python"), Path("file"))
    steps, left_out = everything.plan(tmp_path, options)
    assert not left_out
    assert len({name for name, _ in steps}) == len(steps) > 20  # logs are named by step
    assert {name for name, _ in steps} >= set(everything.DATASETS)
    for _, (_, package, name, *words) in steps:
        if package == "evidence":
            study.command(name).make_context(name, words)  # a UsageError where one is unknown
    fewer, left_out = everything.plan(tmp_path, {}, "render")
    assert {name for name, _ in fewer} == {"render.pareto"}
    assert not left_out


def test_a_failed_step_does_not_stop_the_next(tmp_path: Path) -> None:
    steps = [("bad", ("-c", "print('why'); 1 / 0")), ("good", ("-c", ""))]
    rows = run_steps(steps, tmp_path)
    assert [(row["name"], row["exit_code"]) for row in rows] == [("bad", 1), ("good", 0)]
    assert "why" in (tmp_path / "bad.log").read_text()


def test_studies_run_side_by_side_and_those_that_hold_times_last(tmp_path: Path) -> None:
    meet = (
        "import pathlib, sys, time\n"
        "pathlib.Path({0!r}).touch()\n"
        "for _ in range(200):\n"
        "    if pathlib.Path({1!r}).exists(): sys.exit(0)\n"
        "    time.sleep(0.1)\n"
        "sys.exit(1)"
    )
    first, second = (str(tmp_path / name) for name in "ab")
    after = f"import pathlib, sys; sys.exit(not all(pathlib.Path(f).exists() for f in {[first, second]}))"
    steps = [
        ("fem.pareto", ("-c", after)),  # it holds times
        ("fem.relief", ("-c", meet.format(first, second))),  # each waits for the other
        ("fem.loads", ("-c", meet.format(second, first))),
    ]
    rows = run_steps(steps, tmp_path / "logs", jobs=2)
    assert {row["name"]: row["exit_code"] for row in rows} == dict.fromkeys(
        ("fem.relief", "fem.loads", "fem.pareto"), 0
    )
    assert rows[-1]["name"] == "fem.pareto"


def test_only_results_that_moved_are_made_again(tmp_path: Path) -> None:
    steps, _ = everything.plan(tmp_path, {}, "fem", excluded={"fem.pareto"})
    assert {name for name, _ in steps} == {"fem.relief", "fem.loads", "fem.solvers"}
