"""Flow in another process: errors are passed on, and the process ends with its parent."""

import os
import signal
import subprocess
import sys
import time
from contextlib import closing

import numpy as np
import pytest
from fake_recording import texture

from synth.errors import UserError
from synth.flow.recording.decode import Footage, RecordingFlowSettings
from synth.flow.recording.flow import FlowProcess
from synth.flow.recording.video_pass import VideoPass
from synth.video.read_video import Picture


@pytest.mark.slow
def test_errors_and_the_end_of_the_process_are_reported() -> None:
    rest = texture(64, 80)
    shifted_picture, empty_mask = np.roll(rest, 2, axis=1), np.zeros((64, 80), bool)
    with closing(FlowProcess()) as process:
        with pytest.raises(UserError, match="no estimator"):
            process.begin("nonesuch", rest, empty_mask, ~empty_mask)
        process.begin("dis", rest, empty_mask, ~empty_mask)
        with pytest.raises(UserError, match="does not fit"):
            process.submit(shifted_picture[:-1], empty_mask).result()
        worker = process._pool.submit(os.getpid).result()
        os.kill(worker, signal.SIGINT)  # Ctrl-C in a terminal reaches every process; it must not end this one
        assert np.abs(process.submit(shifted_picture, empty_mask).result().flow).max() > 1
        pictures = [Picture(k, k / 25, rgb) for k, rgb in enumerate((rest, shifted_picture))]
        settings = RecordingFlowSettings("dis", 1, None, masks="none")
        frames = VideoPass(Footage(lambda: pictures, "video"), settings, flow=process).frames()
        assert next(frames).is_rest
        os.kill(worker, signal.SIGKILL)
        with pytest.raises(UserError, match="ended"):
            next(frames)


@pytest.mark.slow
def test_the_process_ends_when_its_parent_is_killed() -> None:
    script = (
        "import os, time; from synth.flow.recording.flow import FlowProcess; flow = FlowProcess();"
        "print(flow._pool.submit(os.getpid).result(), flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        os.kill(worker, 0)
        parent.kill()
    deadline = time.monotonic() + 20
    while os.path.exists(f"/proc/{worker}") and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not os.path.exists(f"/proc/{worker}")
