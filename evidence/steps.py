"""Steps of a long run, one after another, each in a process of its own; passed ones are skipped."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from evidence import report

Step = tuple[str, Sequence[str]]  # its name, and the arguments after `python`


def run_steps(
    steps: Sequence[Step], journal: Path, logs: Path, limit_s: float | None = None
) -> list[dict[str, Any]]:
    """Runs the steps in order; one that fails does not stop the next.

    A step that has passed before, by the same command and commit, is skipped.

    `journal`: JSON of the steps that were run, rewritten after every step; `logs`: folder of NAME.log;
    `limit_s`: time after which a step is stopped. Returns `name`, `command`, `commit`, `exit_code` (-1:
    stopped at its time limit), `wall_s` and `cpu_s` of these steps.
    """
    logs.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = json.loads(journal.read_text("utf-8"))["steps"] if journal.is_file() else []
    commit = report.commit()
    # Files that are not committed may have changed since.
    rows = [row for row in rows if row.get("commit", "") == commit and not commit.endswith("+")]
    passed = {row["command"] for row in rows if row["exit_code"] == 0}
    for name, arguments in steps:
        line = "python " + " ".join(arguments)
        if line in passed:
            continue
        begin, before = time.perf_counter(), os.times()
        with (logs / f"{name.replace(' ', '-')}.log").open("wb") as log:
            try:
                words = [sys.executable, *arguments]
                code = subprocess.run(words, stdout=log, stderr=log, timeout=limit_s).returncode
            except subprocess.TimeoutExpired:
                code = -1
        spent, after = time.perf_counter() - begin, os.times()
        cpu = after.children_user + after.children_system - before.children_user - before.children_system
        rows = [row for row in rows if row["name"] != name]
        about = {"exit_code": code, "wall_s": round(spent, 1), "cpu_s": round(cpu, 1)}
        rows.append({"name": name, "command": line, "commit": commit, **about})
        typer.echo(f"{name}: exit code {code}, {spent:.0f} s, {cpu:.0f} of the CPU", err=True)
        report.save(journal.parent, journal.name, {"steps": rows})
    wanted = {name for name, _ in steps}
    return [row for row in rows if row["name"] in wanted]
