"""The contact sheet of a job, through the command that makes it."""

import json
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from synth.cli import app
from synth.dataset.index import row_of as index_row
from synth.dataset.store import open_sequence
from synth.job.reader import load_job
from synth.publish import cost_probe
from synth.sequence.pipeline import render_sequence


@pytest.mark.slow
def test_preview_draws_scenarios_and_says_what_they_cost(tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.png"
    small = ["render.size=[80, 64]", "sequences=40", "frames=10", "render.spp=4", "anatomy.vertices=900"]
    done = CliRunner().invoke(app, ["preview", "tiny", *small, "-n", "3", "-o", str(sheet), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert cv2.imread(str(sheet)).shape == (128, 160, 3)  # three tiles in a square of four
    assert found["render_cpu_s"] > 0.1
    assert found["cpu_s"] == pytest.approx(sum(found["stages_cpu_s"].values()))
    assert found["disk_bytes"] > 40 * 10 * 80 * 64 * 3 / 2


@pytest.mark.parametrize("target", ["sheet.txt", "missing/sheet.png"])
def test_preview_refuses_what_it_cannot_write(tmp_path: Path, target: str) -> None:
    done = CliRunner().invoke(app, ["preview", "tiny", "-o", str(tmp_path / target)])
    assert done.exit_code != 0
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("frames", [6, 30])
def test_the_estimate_is_within_a_quarter_of_what_it_takes(tmp_path: Path, frames: int) -> None:
    """By processor time, with everything compiled: what a worker takes to start is said to come on top."""
    job = load_job("tiny", ["sequences=5", f"frames={frames}", "render.size=[128, 96]"])
    told = sum(cost_probe.measure_cost(job).values())
    took = 0.0
    for index in range(job.sequences):
        path = render_sequence(job, index, tmp_path, lambda stage, done, of: None)
        took += index_row(open_sequence(path))["cpu_s"]
    assert told == pytest.approx(took, rel=0.25)
