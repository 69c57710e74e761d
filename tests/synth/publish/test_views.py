"""Views of a job and of a dataset: contact sheet, and the recording for the viewer rerun."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from command import run

from synth.cli import app


@pytest.mark.slow
def test_preview_draws_scenarios_and_prints_their_cost(tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.png"
    small = ["render.size=[80, 64]", "sequences=40", "frames=6", "render.spp=4", "anatomy.vertices=900"]
    done = run(app, "preview", "tiny", *small, "-n", 3, "-o", sheet, "--json")
    found = json.loads(done.stdout)
    assert cv2.imread(str(sheet)).shape == (128, 160, 3)  # three tiles in a square of four
    assert found["render_cpu_s"] > 0.1
    assert found["cpu_s"] == pytest.approx(sum(found["stages_cpu_s"].values()))
    assert found["disk_bytes"] > 40 * 6 * 80 * 64 * 3 / 2


@pytest.mark.slow
def test_a_recording_holds_every_field_on_one_timeline(root: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="the extra `view` is not installed")
    path = tmp_path / "one.rrd"
    run(app, "view", root, "-s", 1, "--save", path)
    rerun = [sys.executable, "-m", "rerun", "rrd"]
    subprocess.run([*rerun, "verify", str(path)], check=True, capture_output=True)
    printed = subprocess.run([*rerun, "print", str(path)], check=True, capture_output=True, text=True).stdout
    for entity in ("camera/frame", "camera/depth", "right/frame", "flow", "traction", "force"):
        assert f"- /{entity} - " in printed
    assert "000001" in printed
