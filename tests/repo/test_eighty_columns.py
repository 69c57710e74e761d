"""Tables in a terminal of eighty columns: nothing cut off, no number broken, no unit lost."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.table import Table
from typer.testing import CliRunner

from bench.cli import app as bench
from bench.scoring import report
from evidence import measuring
from learn.cli import _coverage, _pairs, _table
from learn.cli import app as learn
from learn.evaluation.coverage import Coverage
from learn.evaluation.metrics import METRICS
from learn.evaluation.statistics import Interval, Paired
from learn.uncertainty.conformal import LEVELS
from synth.checks.measure import Measure
from synth.checks.verify import Check, Report
from synth.cli import app as synth
from synth.dataset import field_sizes
from synth.fields import FIELDS
from synth.place import command, openings
from synth.system.text_lines import hang
from synth.tune import tuned_job
from synth.tune.result import Row

WIDE = Interval(-0.0135, -0.0251, -0.00831, 40)
"""Numbers as long as they get with three figures."""


@pytest.fixture(autouse=True)
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


def shown(table: Table, *, markup: bool = False) -> str:
    console = Console(width=80, file=io.StringIO(), markup=markup)
    console.print(table)
    return cast(io.StringIO, console.file).getvalue()


def whole(text: str) -> None:
    assert "…" not in text
    assert max(len(line) for line in text.splitlines()) <= 80


def words(text: str) -> list[str]:
    """The words of the first column of a table, whatever line they are on."""
    return [word for line in text.splitlines() for word in re.split(r"\s{2,}", line.strip())[0].split()]


@given(st.text("abc ", max_size=20), st.lists(st.text("xyz", min_size=1, max_size=30), max_size=12))
def test_wrapped_words_are_all_there(head: str, said: list[str]) -> None:
    lines = hang(head, " ".join(said), 60)
    assert all(line[: len(head)].strip() == (head.strip() if k == 0 else "") for k, line in enumerate(lines))
    assert [word for line in lines for word in line[len(head) :].split()] == said
    assert all(len(line) <= 60 for line in lines)


@pytest.mark.parametrize("app", [synth, learn, bench])
def test_help_names_every_command_in_a_whole_sentence(app: typer.Typer) -> None:
    said = CliRunner().invoke(app, ["--help"]).stdout
    whole(said)
    listed = said.split("Commands:")[1]
    assert "..." not in listed
    assert listed.count(".\n") >= len(app.registered_commands)


def test_a_long_path_stays_whole() -> None:
    path = "/" + "x" * 200
    assert hang("ok   ", path, 80) == [f"ok   {path}"]


def test_verify() -> None:
    checks = [Check("forward_backward", ""), Check("visibility", "")]
    checks[0].add(Measure(1.25e-05, 0.000598, "area of all but a tenth of the pixels", "mm^2"), "000123.zarr")
    checks[1].add(Measure(2.0, 1.0, "frame 3", "px"), "000001.zarr")
    *table, failure, verdict = Report("out", 100_000, False, checks).lines()
    text = "\n".join(table)
    whole(text)
    assert "mm^2" in text
    assert "1.25e-05" in text
    for word in ["000123.zarr:", "area", "of", "all", "but", "a", "tenth", "of", "the", "pixels"]:
        assert word in text
    assert failure == "visibility: 000001.zarr: frame 3"
    assert verdict == "not good"


def test_fields() -> None:
    text = "\n".join(field_sizes.lines((4320, 7680)))
    whole(text)
    told = " ".join(text.split())
    for field in FIELDS.values():
        row = next(line for line in text.splitlines() if line.startswith(f"{field.name} "))
        assert re.search(rf" {re.escape(field.unit)} +\S+ [kMG]?B +\S+ [kMG]?B$", row)
        assert " ".join(field.meaning.split()) in told


@dataclass
class Answers:
    """A report whose every number is as long as numbers get."""

    card: Any
    clips: tuple[int, ...] = tuple(range(1234))

    def summary(self, young: str = "known") -> dict[str, float]:
        return dict.fromkeys(METRICS, WIDE.mean)

    def intervals(self) -> dict[str, Interval]:
        return dict.fromkeys(METRICS, WIDE)


CARD: Any = SimpleNamespace(settings=SimpleNamespace(target="density"))


def test_eval() -> None:
    text = shown(_table(cast(Any, Answers(CARD)), "motion-recovered", True))
    whole(text)
    listed = [metric for metric in METRICS.values() if metric.listed]
    assert len(re.findall(r"-0\.0\d+ \[-0\.0\d+, -0\.0\d+\]", text)) == len(listed)
    told = words(text)
    for metric in listed:
        assert set(metric.heading.split()) <= set(told), "labels wrap between words"


def test_eval_against_another_and_its_intervals() -> None:
    pairs = {key: Paired(WIDE, 1.2e-05, 1.0) for key in METRICS}
    text = shown(_pairs(pairs, "models/another", CARD))
    whole(text)
    assert text.count("1.2e-05") == sum(metric.listed for metric in METRICS.values())
    share = Interval(1.0, 0.95, 1.0, 40)
    one = [
        Coverage(level, share, (share,) * 3, share, share, 123.456, 1.0, (1.0,) * 3, 1.0, 1.0)  # type: ignore[arg-type]
        for level in LEVELS
    ]
    text = shown(_coverage(one))
    whole(text)
    assert text.count("100% [95%, 100%]") == 6 * len(LEVELS)
    assert "width of the force's [mN]" in text


def test_score() -> None:
    scores = {
        "mae_mn": 123.4, "mae_of_peak": 12.3456, "bias_mn": -1234.0, "r": -0.979, "r2": -123.4,
        "shape_error": 1.25, "ghost_rate": 1.0,
    }  # fmt: skip
    names = ["D2FNet", "Tikhonov, FEM compliance", "one contact, co-rotational FEM", "my [draft] method"]
    methods = {name: SimpleNamespace(scores=scores) for name in names}
    result: Any = SimpleNamespace(recording="calf 3 [left]", methods=methods, main="D2FNet")
    text = shown(report.terminal_table(result), markup=True)
    whole(text)
    assert "calf 3 [left]" in text
    for unit in ("MAE [mN]", "bias [mN]", "1234.6%", "125.0%", "-1234", "-0.979"):
        assert unit in text
    assert {word for name in names for word in name.split()} <= set(words(text))


def test_place(monkeypatch: pytest.MonkeyPatch) -> None:
    site = SimpleNamespace(point=(-123.456,) * 3, direction=(-0.57735,) * 3, relief_mm=12.345)
    found = SimpleNamespace(chosen=[site] * 20, note="", path=Path("brain.obj"), radius_mm=12.0)
    monkeypatch.setattr(openings, "lines", lambda *_: "anatomy:")
    table = command.Placed(cast(openings.Survey, found), Path("openings")).lines()
    whole("\n".join(table))
    assert "[mm]" in table[0]
    assert "[-123.46, -123.46, -123.46]" in table[20]
    assert "[-0.577, -0.577, -0.577]" in table[20]


def test_tune(monkeypatch: pytest.MonkeyPatch) -> None:
    why = "a pixel of the picture is as wide as the contact, so that no force can be read from it at all"
    rows = [
        Row("depth of field", "steps of 0.0133 s", float("inf"), 12.3, 0.99),
        Row("tets", "400", 0.1, 0.1, 0.5, why),
    ]
    knobs = [SimpleNamespace(name="depth of field"), SimpleNamespace(name="tets")]
    level = SimpleNamespace(words="steps of 0.0133 s")
    found: Any = SimpleNamespace(rows=rows, knobs=knobs, chosen=[level, level], job=None)
    monkeypatch.setattr(tuned_job, "own", lambda knob, job: level)
    text = "\n".join(tuned_job.lines(found))
    whole(text)
    assert " ".join(why.split()) in " ".join(text.split())


def test_what_is_measured(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [{f"column {k} [mN]": 123.456 + k for k in range(12)} for _ in range(2)]
    monkeypatch.setattr(measuring.sys.stdout, "isatty", lambda: True, raising=False)
    measuring._show({"rows": rows, "few": [{"a [px]": 1.5}]})
    text = capsys.readouterr().out
    whole(text)
    assert "a [px]" in text
    told = " ".join(text.split())
    assert all(told.count(f"column {k} [mN] {123.456 + k:.4g}") == 2 for k in range(12))
