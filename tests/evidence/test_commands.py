"""The rooms' commands: every entry loads, and a group runs what its entry names."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from bench.cli import app
from evidence import commands


@pytest.mark.parametrize("entry", commands.COMMANDS, ids=lambda entry: f"{entry.group}-{entry.name}")
def test_entry_loads_and_has_help(entry: commands.Command) -> None:
    assert entry.group in {"pareto", "stability", "experiment"}
    result = CliRunner().invoke(app, [entry.group, entry.name, "--help"])
    assert result.exit_code == 0, result.output


def test_group_runs_the_function_of_its_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = commands.Command("pareto", "sum", "tests_bench_sum", "total", "2 5")

    class Module:
        @staticmethod
        def total(a: int, b: int) -> None:
            """Adds."""
            print(a + b)

    monkeypatch.setattr(commands, "COMMANDS", (entry,))
    monkeypatch.setattr(commands, "import_module", lambda name: {"tests_bench_sum": Module}[name])
    result = CliRunner().invoke(app, ["pareto", "sum", "2", "5"])
    assert result.exit_code == 0
    assert result.output.strip() == "7"
    assert CliRunner().invoke(app, ["stability", "sum", "2", "5"]).exit_code == 2
