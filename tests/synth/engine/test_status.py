"""Status and forecast agree with the files, during a run and after it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fake_run import Silent, options, start, wait_for
from typer.testing import CliRunner

from synth.cli import app
from synth.dataset.folder import Folder
from synth.engine import run as engine
from synth.engine import status
from synth.engine.journal import Journal
from synth.job.schema import Job

JOB = Job(seed=2, sequences=6, frames=3, render={"size": (32, 24)}, flow={"backend": "ideal"})


@pytest.mark.slow
def test_status_during_and_after_a_run(tmp_path: Path) -> None:
    root = tmp_path / "out"
    run = start(root, JOB, "slow")
    wait_for(lambda: bool(root.exists() and (root / ".run/progress.json").exists()))
    wait_for(lambda: bool(status.read_status(root).in_flight) or status.read_status(root).done == 6)
    during = status.read_status(root)
    assert during.total == 6
    assert during.running or during.done == 6
    assert run.wait(timeout=60) == 0
    after = status.read_status(root)
    assert (after.done, after.failed, after.running, after.in_flight) == (6, {}, False, {})
    assert after.ahead.sequences == 0
    assert after.stages_cpu_s["render"] > 0


@pytest.mark.slow
def test_failures_are_counted_by_reason_and_retried(tmp_path: Path) -> None:
    job = JOB.model_copy(update={"sequences": 7})
    engine.run_job(job, tmp_path / "out", options("trying"), Silent())
    found = status.read_status(tmp_path / "out")
    assert (found.done, found.failed) == (5, {"the load is past the material's range": 2})
    shown = CliRunner().invoke(app, ["status", str(tmp_path / "out"), "--json"]).stdout
    assert json.loads(shown)["done"] == 5


def test_the_time_left_is_estimated_from_the_latest_sequences(tmp_path: Path) -> None:
    def left(workers: int, todo: int, *ends: float) -> float | None:
        journal = Journal(Folder(tmp_path), workers, Silent().account)
        journal._left = todo
        for at in ends:
            journal.pace(at)
        return journal.left_s()

    assert left(2, 10, 20.0, 21.0) is None, "the first sequence of each worker includes compilation"
    assert left(2, 10, 20.0, 21.0, 25.0, 26.0) == pytest.approx(10 * 2.5)
    slow, fast = [10.0 * k for k in range(1, 101)], [1000.0 + 2.0 * k for k in range(1, 101)]
    assert left(1, 50, *slow, *fast) == pytest.approx(100)
