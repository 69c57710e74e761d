"""The rooms' commands: every entry loads, and a group runs what its entry names."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from bench.cli import app
from bench.output import write
from evidence import commands
from evidence import measuring as shared
from evidence.measuring import measuring


@pytest.mark.parametrize("words", commands.COMMANDS)
def test_entry_loads_and_has_help(words: str) -> None:
    assert words.split()[0] in {"pareto", "stability", "experiment"}
    result = CliRunner().invoke(app, [*words.split(), "--help"])
    assert result.exit_code == 0, result.output


def test_group_runs_the_function_of_its_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    class Module:
        @staticmethod
        @measuring("2 5")
        def total(a: int, b: int) -> None:
            """Adds."""
            print(a + b)

    monkeypatch.setattr(commands, "COMMANDS", {"pareto sum": "tests_bench_sum:total"})
    monkeypatch.setattr(commands, "import_module", lambda name: {"tests_bench_sum": Module}[name])
    result = CliRunner().invoke(app, ["pareto", "sum", "2", "5"])
    assert result.exit_code == 0
    assert result.output.strip() == "7"
    assert CliRunner().invoke(app, ["stability", "sum", "2", "5"]).exit_code == 2


def _app(function: Callable[..., Any]) -> typer.Typer:
    alone = typer.Typer()
    shared.hang_into(alone, function, "experiment count")
    return alone


def test_data_are_kept_with_command_and_machine_and_said(tmp_path: Path) -> None:
    @measuring(
        "3",
        file="count-{source}.json",
        page=lambda found, out: write.keep(out, "page.txt", str(found["sum"])),
        text=lambda found: f"sum {found['sum']}",
        passed=lambda found: found["sum"] < 10,
    )
    def count(
        source: Annotated[Path, typer.Argument()],
        upto: Annotated[list[int] | None, typer.Option()] = None,
        low: Annotated[int, typer.Option()] = 0,
        fast: Annotated[bool, typer.Option("--fast")] = False,
        model: Annotated[str, typer.Option()] = "",
    ) -> dict[str, Any]:
        """Counts."""
        return {"sum": low + sum(upto or ())}

    words = [str(tmp_path / "some where.csv"), "--upto", "3", "--upto", "4", "--low=-1", "--fast"]
    words += ["--model", "small one=/some/where/small"]
    said = CliRunner().invoke(_app(count), [*words, "--out", str(tmp_path / "kept")])
    assert (said.exit_code, said.output) == (0, "sum 6\n")
    kept = json.loads((tmp_path / "kept/count-some where.json").read_text())
    assert kept["command"] == (
        "bench experiment count 'some where.csv' --upto 3 --upto 4 --low=-1 --fast --model 'small one=small'"
    )
    assert set(kept) == {"command", "machine", "sum"}
    assert (tmp_path / "kept/page.txt").read_text() == "6"
    loud = CliRunner().invoke(_app(count), [*words, "--json", "--upto", "9"])
    assert (loud.exit_code, json.loads(loud.output)["sum"]) == (1, 15)
    assert count(Path("x"), low=2) == {"sum": 2}, "the function itself stays a function"


def test_a_default_folder_of_results_is_the_checkouts_and_a_typed_one_the_callers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @measuring("", out="docs/results/count", text="README.md")
    def count(out: Path) -> dict[str, Any]:
        """Counts."""
        return {"out": str(out)}

    monkeypatch.chdir(tmp_path)
    default = CliRunner().invoke(_app(count), ["--json"])
    assert Path(json.loads(default.output)["out"]) == shared.CHECKOUT / "docs/results/count"
    typed = CliRunner().invoke(_app(count), ["--out", "docs/results/count"])
    assert typed.output.strip() == "docs/results/count/README.md"
    help_text = CliRunner().invoke(_app(count), ["--help"]).output
    assert str(shared.CHECKOUT) not in help_text
    assert "docs/results/count" in help_text


def test_an_out_that_must_be_given_and_commands_that_say_all_themselves() -> None:
    @measuring("", out=..., file="count.json")
    def count() -> dict[str, Any]:
        """Counts."""
        return {}

    @measuring("")
    def speak() -> None:
        """Speaks."""
        print("said")

    assert CliRunner().invoke(_app(count), []).exit_code == 2
    assert CliRunner().invoke(_app(speak), []).output == "said\n"
    assert CliRunner().invoke(_app(speak), ["--json"]).exit_code == 2
