"""Stored results: their provenance and charts, whether they are up to date, making all of them again."""

import json
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from evidence import all as everything
from evidence import report, status, study
from evidence.learn import shipped
from evidence.report import Page
from evidence.steps import run_steps
from learn.inference.shipped import MODELS, NAMES

CHART = report.intervals("error", "mN", {"ours": (1.0, 0.5, 2.0), "<theirs>": (2.0,)})
ROWS = [{"law": "<linear>", "error": 0.0123456}, {"law": "stable", "error": None, "why": "a | b"}]


def test_data_are_stored_with_their_provenance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["x", "/some/where.csv", "--cache=/a/b", "-o", "/tmp/o", "--seeds", "3"])
    report.save(
        tmp_path,
        "found.json",
        {"third": 1 / 3, "rows": ROWS},
        lambda found: Page("Title", found, chart=CHART),
    )
    found = json.loads((tmp_path / "found.json").read_text())
    assert list(found) == ["command", "commit", "machine", "cpu_hours", "third", "rows"]
    assert found["command"].endswith("where.csv --cache=b --seeds 3")
    assert found["third"] == 0.333333
    again = found | {"commit": "1234567"}
    report.save(tmp_path, "found.json", again)
    assert json.loads((tmp_path / "found.json").read_text()) == again
    text = " ".join(ElementTree.fromstring((tmp_path / "chart.svg").read_text()).itertext())
    assert all(value in text for value in ("mN", "ours", "<theirs>"))


def test_pareto_front() -> None:
    assert report.front([(2.0, 1.0), (1.0, 3.0), (3.0, 2.0), (1.0, 2.0)]) == [3, 0]


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A checkout with a script, an imported module, another module, data, and the script's result."""
    files = {
        "evidence/flow/pareto.py": "from synth import flow",
        "synth/__init__.py": "",
        "synth/flow.py": "import synth.job",
        "synth/job.py": "SIZE = 1",
        "synth/other.py": "",
        "data/job.yaml": "frames: 3",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "first")
    found = {
        "command": "python -m evidence.flow.pareto --seeds 3",
        "commit": git(tmp_path, "rev-parse", "--short", "HEAD").strip(),
        "cpu_hours": 1.5,
        "data": status.data(tmp_path / "data/job.yaml", home=tmp_path),
    }
    (tmp_path / "results").mkdir()
    (tmp_path / "results/pareto.json").write_text(json.dumps(found))
    return tmp_path


def git(folder: Path, *words: str) -> str:
    return subprocess.run(["git", "-C", folder, *words], check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize(
    ("changed", "found"),
    [("synth/other.py", ()), *((name, (name,)) for name in ("synth/job.py", "data/job.yaml"))],
)
def test_stale_if_imports_or_data_changed(home: Path, changed: str, found: tuple[str, ...]) -> None:
    modules = {"*.json": "evidence.flow.pareto"}
    assert [one.changed for one in status.gather(home / "results", modules, home)] == [()]
    (home / changed).write_text((home / changed).read_text() + "\n")
    (one,) = status.gather(home / "results", modules, home)
    assert (one.changed, one.cpu_hours) == (found, 1.5)


POOLED = "foreign.recordings", "scoring.exvivo"  # their pages are of `bench pool`
DRAWN = [name for name in study.names() if name not in POOLED]


@pytest.mark.parametrize("name", DRAWN)
def test_the_page_of_a_study_is_drawn_from_its_stored_data(name: str, tmp_path: Path) -> None:
    one = study.load(name)
    if one.page is None:
        assert not one.result
        return
    found = json.loads((report.RESULTS / one.result).read_text("utf-8"))
    one.page(found).write(tmp_path)
    assert (tmp_path / "README.md").read_text("utf-8").startswith("# ")


@pytest.mark.parametrize("name", NAMES)
def test_figures_of_a_network_card_are_those_of_the_stored_result(name: str) -> None:
    rows = json.loads((report.RESULTS / "learn/shipped/shipped.json").read_text("utf-8"))["rows"]
    shown = (MODELS / name / "README.md").read_text("utf-8")
    listed = shipped.listed([row for row in rows if row["model"] == name])
    assert len(listed) == 2
    assert all(f"| {what} | {figures} |\n" in shown for what, figures in listed.items())


def test_every_stored_result_has_its_study() -> None:
    results = [study.load(name).result for name in study.names()]
    found = [{*report.RESULTS.glob(result)} for result in results if result]
    assert all(found)
    assert set.union(*found) == {*report.RESULTS.rglob("*.json")}
    assert sum(map(len, found)) == len(set.union(*found))


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


def test_only_failed_steps_are_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evidence.report.commit", lambda: "abc")
    write = "open('{}', 'a').write('x'){}"
    steps = [("good", ("-c", write.format("good", ""))), ("bad", ("-c", write.format("bad", "; 1 / 0")))]
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        rows = run_steps(steps, tmp_path / "steps.json", tmp_path)
    assert [row["exit_code"] for row in sorted(rows, key=lambda row: row["name"])] == [1, 0]
    assert [(tmp_path / name).read_text() for name in ("good", "bad")] == ["x", "xx"]
