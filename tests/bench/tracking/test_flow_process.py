"""Flow in a process of its own: the same answers, errors that arrive, and an end whatever happens."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from bench.tracking.flow_process import FlowProcess
from synth.errors import UserError
from synth.flow.mask_selection import Proposal
from synth.recording_flow.video_flow import Footage, RecordingFlowSettings, VideoFlow
from synth.video.read import Picture


def pictures() -> tuple[np.ndarray, np.ndarray, Proposal]:
    rng = np.random.default_rng(3)
    rest = np.kron(rng.integers(40, 220, (16, 20)), np.ones((4, 4)))[..., None].repeat(3, 2).astype(np.uint8)
    nothing = np.zeros(rest.shape[:2], bool)
    return rest, np.roll(rest, 2, axis=1), Proposal(nothing, nothing, nothing)


@pytest.fixture
def elsewhere() -> Iterator[FlowProcess]:
    with closing(FlowProcess()) as flow:
        yield flow


@pytest.mark.slow
def test_errors_of_the_flow_arrive_and_its_end_is_said(elsewhere: FlowProcess) -> None:
    rest, moved, free = pictures()
    with pytest.raises(UserError, match="no estimator"):
        elsewhere.begin("nonesuch", rest, free, ~free.known)
    elsewhere.begin("dis", rest, free, ~free.known)
    with pytest.raises(UserError, match="does not fit"):
        elsewhere.submit(moved[:-1], free).result()
    worker = elsewhere._pool.submit(os.getpid).result()
    os.kill(worker, signal.SIGINT)  # a terminal's Ctrl-C reaches every process; this one is closed instead
    assert np.abs(elsewhere.submit(moved, free).result().flow).max() > 1
    footage = Footage([Picture(k, k / 25, one) for k, one in enumerate((rest, moved))], "film")
    frames = VideoFlow(footage, RecordingFlowSettings("dis", 1, None, masks="none"), elsewhere).frames()
    assert next(frames).is_rest
    os.kill(worker, signal.SIGKILL)
    with pytest.raises(UserError, match="ended"):
        next(frames)


@pytest.mark.slow
def test_it_does_not_outlive_a_killed_parent() -> None:
    script = (
        "import os, time; from bench.tracking.flow_process import FlowProcess; flow = FlowProcess();"
        "print(flow._pool.submit(os.getpid).result(), flush=True); time.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    os.kill(worker, 0)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 20
    while os.path.exists(f"/proc/{worker}") and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not os.path.exists(f"/proc/{worker}")
