"""The run that makes all results again: arguments of its scripts, skipping of passed steps."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest
import typer

from evidence import all as everything
from evidence.steps import run_steps

PYTHON = Path("python")


def test_every_script_accepts_the_arguments_of_its_step(tmp_path: Path) -> None:
    steps = [*everything.standalone(tmp_path), *everything.photograph(PYTHON)]
    steps += [*everything.exvivo(tmp_path, PYTHON), *everything.shared(tmp_path)]
    steps += everything.foreign(tmp_path, PYTHON, PYTHON)
    scripts = [words[1:] for _, words in steps if words[1].startswith("evidence.")]
    assert len({name for name, _ in steps}) == len(steps) > len(scripts) > 25  # logs are named by step
    for module, *words in scripts:
        app = typer.Typer()
        app.command()(import_module(module).main)
        typer.main.get_command(app).make_context(module, words)  # a UsageError where one is unknown


def test_only_failed_steps_are_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evidence.report.commit", lambda: "abc")
    write = "open('{}', 'a').write('x'){}"
    steps = [("good", ("-c", write.format("good", ""))), ("bad", ("-c", write.format("bad", "; 1 / 0")))]
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        rows = run_steps(steps, tmp_path / "steps.json", tmp_path)
    assert [row["exit_code"] for row in sorted(rows, key=lambda row: row["name"])] == [1, 0]
    assert [(tmp_path / name).read_text() for name in ("good", "bad")] == ["x", "xx"]
