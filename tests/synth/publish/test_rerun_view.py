"""The recording for the viewer rerun."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from synth.cli import app


@pytest.mark.slow
def test_a_recording_holds_every_field_on_one_timeline(root: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="the extra `view` is not installed")
    path = tmp_path / "one.rrd"
    made = CliRunner().invoke(app, ["view", str(root), "-s", "1", "--save", str(path)])
    assert made.exit_code == 0, made.output
    rerun = [sys.executable, "-m", "rerun", "rrd"]
    subprocess.run([*rerun, "verify", str(path)], check=True, capture_output=True)
    printed = subprocess.run([*rerun, "print", str(path)], check=True, capture_output=True, text=True).stdout
    for entity in ("camera/frame", "camera/depth", "right/frame", "flow", "traction", "force"):
        assert f"- /{entity} - " in printed
    assert "000001" in printed
