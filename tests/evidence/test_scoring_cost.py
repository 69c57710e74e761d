"""Recordings made to be scored: the one that scoring's cost is measured on, stand-ins for ex vivo ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.recording.folder import open_recording
from bench.tracking.tracking import track_recording
from evidence.scoring import exvivo, scoring_cost
from learn.inference.video_flow import Settings


def test_the_bump_moves_as_the_sensor_says(tmp_path: Path) -> None:
    scoring_cost.record(tmp_path / "rec", 3.0, 10.0, (128, 96), np.random.default_rng(0))
    recording = open_recording(tmp_path / "rec")
    assert recording.expected_frames() == 30
    done = track_recording(recording, {}, 35 / 128, Settings("dis", shrink=1, rate_hz=None))
    # Still for half a second, then away, at the peak after a quarter of the period, then back.
    speed = np.array(done.speed)
    assert speed[:5].max() < 0.1 * speed[5:].max()
    peak = int(np.argmax(recording.force.force_mn[:, 0])) if recording.force is not None else -1
    assert peak / 200 == pytest.approx(1.5, abs=0.02)


def test_the_result_is_told_with_both_processes_memory() -> None:
    stage = {"cpu_s": 1.0, "wall_s": 2.0}
    tree = {
        "seconds": 60.0,
        "fps": 30.0,
        "size": [680, 480],
        "frames": 600,
        "wall_s": 90.0,
        "timings": {"flow": stage, "peak_rss_mb": 800.0, "flow_peak_rss_mb": 400.0},
        "machine": {"processor": "P", "cores": 2, "memory_gb": 8.0},
        "command": "bench experiment scoring MODEL --train DATA",
    }
    told = scoring_cost.drawn(tree).text()
    assert "*90 s, 1.5 times the" in told
    assert "1.2 GB" in told
    assert "| flow | 1.0 | 2.0 |" in told


@pytest.mark.slow
def test_a_stand_in_has_a_second_eye_where_asked(tmp_path: Path) -> None:
    plan = exvivo.Plan(seconds=18.0, fps=0.5, size=(96, 72), eyes=2)
    recording = open_recording(exvivo.make(plan, 0, tmp_path / "000"))
    left, right = list(recording.frames()), list(recording.right_frames())
    assert len(left) == len(right) == 9
    done = track_recording(recording, {}, 35 / 96, Settings("dis", shrink=1, rate_hz=None, pulse=False))
    assert done.sight is not None
    assert done.sight.baseline_mm == pytest.approx(24.0, abs=1e-6)
    assert done.sight.epipolar_px < 0.3, "the calibration is that of the pictures"
    assert np.abs(left[0].rgb.astype(int) - right[0].rgb.astype(int)).mean() > 4, "two places"
