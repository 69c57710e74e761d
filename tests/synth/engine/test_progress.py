"""Progress: a line now and then without a terminal, bars with rates under them on one."""

from __future__ import annotations

import pytest

from synth.engine import progress
from synth.engine.journal import Account
from synth.engine.progress import Bars, clock
from synth.engine.worker_process import Attempt

ACCOUNT = Account(2, 4.0, 1, 125.0, True, {"render": 0.62}, 1.25, 3e9, int(4e10), {})


def go(bars: Bars) -> None:
    with bars:
        bars.begin(4, 1, 1)
        bars.stage(2, "render", 1, 8)
        bars.account(ACCOUNT)
        bars.end(Attempt(2, "crash", "the process died of SIGSEGV"), True)
        bars.end(Attempt(3, "stopped"), False)
        bars.end(Attempt(2, "done"), False)
        bars.end(Attempt(3, "done"), False)


def test_lines_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    go(Bars())
    rates = "render 0.62 s a step; 1.2 frames/s in all; 3 GB to come, 40 GB free"
    assert capsys.readouterr().err.splitlines() == [
        "1 of 4 sequences are there already, 1 failed (`synth retry` takes them up again)",
        "sequence 000002 is tried again: the process died of SIGSEGV",
        f"4 of 4 sequences, 0 s spent, at most 2:05 min left; {rates}",
    ]


def test_every_end_is_a_line_when_they_are_rare(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "_QUIET_S", 0.0)
    go(Bars())
    assert sum("spent" in line for line in capsys.readouterr().err.splitlines()) == 2


def test_bars_on_a_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.delenv("NO_COLOR", raising=False)
    bars = Bars()
    assert not bars.disable
    with bars:
        bars.begin(4, 0, 0)
        bars.stage(2, "render", 1, 8)
        bars.account(ACCOUNT)
        bars.refresh()
        shown = capsys.readouterr().err
        bars.end(Attempt(2, "done"), False)
    for words in ("sequences", "000002 render", "1/8", "0/4", "at most 2:05 min left", "3 GB to come"):
        assert words in shown
    assert [task.completed for task in bars.tasks] == [1]


def test_times_for_people() -> None:
    assert [clock(s) for s in (9.4, 125, 12_000, 362_880)] == ["9 s", "2:05 min", "3:20 h", "4.2 days"]
