"""The run that makes kept results anew: its commands fit the scripts, what passed is not run again."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest
import typer

from evidence import all as everything
from evidence.steps import run_steps

PYTHON = Path("python")


def test_every_script_takes_what_its_step_gives_it(tmp_path: Path) -> None:
    steps = [*everything.rooms(tmp_path), *everything.look(PYTHON), *everything.exvivo(tmp_path, PYTHON)]
    steps += [*everything.foreign(tmp_path, PYTHON, PYTHON), *everything.shared(tmp_path)]
    scripts = [words[1:] for _, words in steps if words[1].startswith("evidence.")]
    assert len({name for name, _ in steps}) == len(steps) > len(scripts) > 25  # its name finds a step's log
    for module, *words in scripts:
        app = typer.Typer()
        app.command()(import_module(module).main)
        typer.main.get_command(app).make_context(module, words)  # a UsageError where one is unknown


def test_what_has_passed_is_not_run_again_and_what_failed_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("evidence.report.commit", lambda: "abc")
    steps = [
        ("good", ("-c", "open('good', 'a').write('x')")),
        ("bad", ("-c", "open('bad', 'a').write('x'); 1 / 0")),
    ]
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        rows = run_steps(steps, tmp_path / "steps.json", tmp_path)
    assert [row["exit_code"] for row in sorted(rows, key=lambda row: row["name"])] == [1, 0]
    assert [(tmp_path / name).read_text() for name in ("good", "bad")] == ["x", "xx"]
