"""Results of a measurement: data with their provenance, charts."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from evidence import report
from evidence.report import Chart, Curve, Page, Panel, bars

PANEL = Panel("cost", "ms", "error [%]", (Curve("P2 <fast>", (1.0, 10.0), (4.0, float("nan")), ("a", "b")),))
CHART = Chart("error", "mN", bars({"ours": 1.0, "theirs": 2.0}, {"ours": (0.5, 1.5)}))
ROWS = [{"law": "<linear>", "error": 0.0123456}, {"law": "stable", "error": None, "why": "a | b"}]


def test_data_are_stored_with_their_provenance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["x", "/some/where.csv", "--cache=/a/b", "-o", "/tmp/o", "--seeds", "3"])
    report.save(tmp_path, "found.json", {"third": 1 / 3, "rows": ROWS}, Page("Title", {}, [PANEL, CHART]))
    found = json.loads((tmp_path / "found.json").read_text())
    assert list(found) == ["command", "commit", "machine", "cpu_hours", "third", "rows"]
    assert found["command"].endswith("where.csv --cache=b --seeds 3")
    assert found["third"] == 0.333333
    again = found | {"commit": "1234567"}
    report.save(tmp_path, "found.json", again)
    assert json.loads((tmp_path / "found.json").read_text()) == again
    for name, values in (("chart.svg", {"error [%]", "P2 <fast>"}), ("intervals.svg", {"mN", "theirs"})):
        text = " ".join(ElementTree.fromstring((tmp_path / name).read_text()).itertext())
        assert all(value in text for value in values)


def test_pareto_front() -> None:
    assert report.front([(2.0, 1.0), (1.0, 3.0), (3.0, 2.0), (1.0, 2.0)]) == [3, 0]
