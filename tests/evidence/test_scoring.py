"""Ex vivo stand-ins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.recording.folder import open_recording
from bench.tracking.tracking import track_recording
from evidence.scoring import exvivo
from synth.recording_flow.video_flow import RecordingFlowSettings


@pytest.mark.slow
def test_a_stereo_stand_in_agrees_with_its_calibration(tmp_path: Path) -> None:
    plan = exvivo.Plan(seconds=18.0, fps=0.5, size=(96, 72), cameras=2)
    recording = open_recording(exvivo.make(plan, 0, tmp_path / "000"))
    left, right = list(recording.frames()), list(recording.right_frames())
    assert len(left) == len(right) == 9
    done = track_recording(
        recording, {}, 35 / 96, RecordingFlowSettings("dis", shrink=1, rate_hz=None, pulse=False)
    )
    assert done.stereo is not None
    assert done.stereo.baseline_mm == pytest.approx(24.0, abs=1e-6)
    assert done.stereo.epipolar_px < 0.3, "the calibration fits the images"
    assert np.abs(left[0].rgb.astype(int) - right[0].rgb.astype(int)).mean() > 4, (
        "the cameras are in different places"
    )
