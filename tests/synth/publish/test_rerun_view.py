"""Viewing: a recording that rerun finds whole, a surface where the depth says, on this machine only."""

from __future__ import annotations

import builtins
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_work import consistent
from typer.testing import CliRunner

from synth.checks import optics
from synth.cli import app
from synth.dataset.store import Dataset
from synth.job.schema import Job
from synth.publish import rerun_view
from synth.render.camera import camera

JOB = Job(sequences=2, frames=3, render={"size": (48, 36)})


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("view")
    for index in range(JOB.sequences):
        consistent(JOB, index, out, lambda *_: None)
    return out


def test_the_surface_is_where_flow_and_depth_say(root: Path) -> None:
    sequence = Dataset(root)[0]
    points, faces = rerun_view.surface(sequence, 2, 4)
    rest, _ = rerun_view.surface(sequence, 0, 4)
    assert len(points) == len(rest) == 9 * 12
    assert faces.size
    moved = (points - rest)[np.unique(faces)]
    # Slides by 6 px of 0.3 mm in the last frame, at one depth.
    assert moved == pytest.approx(np.tile([1.8, 0.0, 0.0], (len(moved), 1)), abs=1e-3)
    seen = camera.to_pixels(optics.camera_of(sequence), rest[np.unique(faces)])
    assert seen == pytest.approx(seen.round() // 4 * 4, abs=1e-3)


@pytest.mark.slow
def test_a_recording_holds_every_field_on_one_timeline(root: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="the extra `view` is not installed")
    path = tmp_path / "two.rrd"
    made = CliRunner().invoke(app, ["view", str(root), "-s", "0", "-s", "1", "--save", str(path)])
    assert made.exit_code == 0, made.output
    rerun = [sys.executable, "-m", "rerun", "rrd"]
    subprocess.run([*rerun, "verify", str(path)], check=True, capture_output=True)
    said = subprocess.run([*rerun, "print", str(path)], check=True, capture_output=True, text=True).stdout
    for entity in ("camera/frame", "flow", "flow_recovered", "traction", "force", "tissue"):
        assert f"- /{entity} - " in said
    assert "000000" in said
    assert "000001" in said


def test_the_viewer_listens_on_this_machine_only(tmp_path: Path) -> None:
    for web in (False, True):
        words = rerun_view.command(tmp_path / "a.rrd", web=web)
        assert words[words.index("--bind") + 1] == "127.0.0.1"
        assert ("--serve-web" in words) == web


def test_without_the_extra_it_is_one_line(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real: Callable[..., Any] = builtins.__import__

    def without(name: str, *more: Any) -> Any:
        if name == "rerun":
            raise ImportError(name)
        return real(name, *more)

    monkeypatch.setattr(builtins, "__import__", without)
    made = CliRunner().invoke(app, ["view", str(root), "--save", str(root / "a.rrd")])
    assert made.exit_code == 2
    assert "pip install '.[view]' in the clone" in made.output


@pytest.mark.slow
def test_the_viewers_own_process_ends_with_the_command(root: Path, tmp_path: Path) -> None:
    """`python -m rerun` starts the viewer in its turn; a SIGTERM to ours must not leave that behind."""
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    words = [sys.executable, "-m", "synth", "view", str(root), "--web"]
    started = subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        assert waited(lambda: len(of_viewer(tmp_path)) >= 2, 120), of_viewer(tmp_path)
        started.terminate()
        started.wait(60)
        assert waited(lambda: not of_viewer(tmp_path), 30), of_viewer(tmp_path)
    finally:
        started.kill()
        started.wait()
        for process in of_viewer(tmp_path):
            os.kill(process, signal.SIGKILL)


def of_viewer(scratch: Path) -> list[int]:
    """Processes that were given a recording in `scratch`."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = (entry / "cmdline").read_bytes().split(b"\0")
            if any(word.startswith(f"{scratch}/".encode()) for word in words):
                found.append(int(entry.name))
    return found


def waited(true: Callable[[], bool], seconds: float) -> bool:
    """Whether it comes true in that time."""
    until = time.monotonic() + seconds
    while not true() and time.monotonic() < until:
        time.sleep(0.2)
    return true()
