"""Status and forecast: what they say is what is on disk, during a run and after it."""

from __future__ import annotations

import json
import shutil
from collections import namedtuple
from pathlib import Path

import pytest
from fake_run import Silent, options, start, wait_for
from typer.testing import CliRunner

from synth.cli import app
from synth.dataset import size_forecast
from synth.engine import run as engine
from synth.engine import status
from synth.errors import UserError
from synth.job.schema import Job

JOB = Job(seed=2, sequences=6, frames=3, render={"size": (32, 24)}, flow={"backend": "ideal"})


@pytest.mark.slow
def test_status_during_and_after_a_run(tmp_path: Path) -> None:
    root = tmp_path / "out"
    run = start(root, JOB, "slow")
    wait_for(lambda: bool(root.exists() and (root / ".run/progress.json").exists()))
    wait_for(lambda: bool(status.read_status(root).in_flight) or status.read_status(root).done == 6)
    seen = status.read_status(root)
    assert seen.total == 6
    assert seen.running or seen.done == 6
    assert run.wait(timeout=60) == 0
    after = status.read_status(root)
    assert (after.done, after.failed, after.running, after.in_flight) == (6, {}, False, {})
    assert after.ahead.sequences == 0
    assert after.stages_cpu_s["render"] > 0


@pytest.mark.slow
def test_failures_are_counted_by_reason_and_retried(tmp_path: Path) -> None:
    job = JOB.model_copy(update={"sequences": 7})
    engine.run_job(job, tmp_path / "out", options("trying"), Silent())
    seen = status.read_status(tmp_path / "out")
    assert (seen.done, seen.failed) == (5, {"the load is past the material's range": 2})
    text = CliRunner().invoke(app, ["status", str(tmp_path / "out")]).stdout
    assert "5 of 7 sequences done, 2 failed" in text
    assert "2 x the load is past the material's range" in text
    shown = CliRunner().invoke(app, ["status", str(tmp_path / "out"), "--json"]).stdout
    assert json.loads(shown)["done"] == 5


@pytest.mark.slow
def test_forecast_rests_on_finished_sequences(tmp_path: Path) -> None:
    root = tmp_path / "out"
    engine.run_job(JOB, root, options("sequence"), Silent())
    whole = sum(size_forecast.size(path) for path in root.glob("*.zarr"))
    ahead = size_forecast.forecast_rest(JOB, root, 600, list(range(6)), 2.0)
    assert ahead.bytes == pytest.approx(100 * whole, rel=1e-6)
    assert (ahead.cpu_s, ahead.pilot) == (1200.0, 6)


def test_estimate_without_any_is_no_wilder_than_twofold_on_rendered_pictures() -> None:
    """Against a rendered demo sequence: 8 frames of 256 x 192 px took 4.16 MB."""
    job = Job(frames=8, render={"size": (256, 192)})
    assert 0.5 < size_forecast.estimate(job) / 4.16e6 < 2.0


def test_a_disk_too_small_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 10**9, 10**5))
    with pytest.raises(UserError, match=r"6 sequences need .* the disk has 100 kB free"):
        engine.run_job(JOB, tmp_path / "out", options("sequence"), Silent())
    assert not (tmp_path / "out").exists()


def test_no_dataset_is_one_line(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["status", str(tmp_path)])
    assert done.exit_code == 2
    assert "holds no dataset" in done.stderr
