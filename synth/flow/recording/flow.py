"""A stage of a video: flow from the rest frame, here or in another process.

The other process works on the next frame while forces of the current one are computed. Threads are no
alternative: flow makes thousands of short calls per frame and would wait for the interpreter after each (two
threads take longer than one).
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context, parent_process

from synth.arrays import Mask, Pixels
from synth.flow.confidence import add_deviation
from synth.flow.estimator import Estimator
from synth.flow.recording.frame_motion import FrameMotion
from synth.flow.track import Tracker
from synth.system import resources


class LocalFlow:
    """Computes flow frame by frame in this process; `FlowProcess` in another one."""

    ahead = 0  # number of frames that may be submitted before the first result is awaited

    def begin(self, backend: str | Estimator, rest: Pixels, masked: Mask, tissue: Mask) -> None:
        """Starts with the rest frame; arguments and errors as for `Tracker`."""
        self._tracker = Tracker(backend, rest, masked, tissue)

    def submit(self, rgb: Pixels, masked: Mask) -> Future[FrameMotion]:
        """Computes the motion of a frame (h, w, 3); arguments and errors as for `Tracker.step`."""
        cpu, wall, tracker = time.process_time(), time.perf_counter(), self._tracker
        resets = tracker.resets
        flow, confidence = tracker.step(rgb, masked)
        future: Future[FrameMotion] = Future()
        future.set_result(
            FrameMotion(
                flow,
                confidence,
                tracker.trusted,
                tracker.trusted and tracker.resets > resets,
                cpu_s=time.process_time() - cpu,
                wall_s=time.perf_counter() - wall,
            )
        )
        return future


class FlowProcess(LocalFlow):
    """Flow in another process, which starts at once and ends with this one."""

    ahead = 1

    def __init__(self) -> None:
        self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_begin_process)
        # The other process inherits the blocked SIGINT: on Ctrl-C this process closes it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._pool.submit(os.getpid)  # the first task starts the process
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def begin(self, backend: str | Estimator, rest: Pixels, masked: Mask, tissue: Mask) -> None:
        """See `LocalFlow`."""
        self._pool.submit(_begin, backend, rest, masked, tissue).result()

    def submit(self, rgb: Pixels, masked: Mask) -> Future[FrameMotion]:
        """See `LocalFlow`."""
        return self._pool.submit(_step, rgb, masked)

    def close(self) -> None:
        """Ends the process after its current frame."""
        self._pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def open_flow_process() -> Iterator[FlowProcess | None]:
    """A process for flow, closed at the end; None on a single core."""
    if resources.cores() < 2:
        yield None
        return
    with contextlib.closing(FlowProcess()) as process:
        yield process


_flow = LocalFlow()  # of the other process, for one video at a time


def _begin_process() -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Ends the process with its parent, which when killed would leave it waiting for tasks."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _begin(backend: str | Estimator, rest: Pixels, masked: Mask, tissue: Mask) -> None:
    _flow.begin(backend, rest, masked, tissue)


def _step(rgb: Pixels, masked: Mask) -> FrameMotion:
    frame = _flow.submit(rgb, masked).result()
    return replace(frame, peak_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)


def with_flow(frame: FrameMotion, solution: FrameMotion) -> FrameMotion:
    """A frame with the flow `solution` for it, whose uncertainty includes that of the camera's motion."""
    confidence = solution.confidence
    if frame.camera is not None:
        confidence = add_deviation(confidence, frame.camera.deviation_px)
    return replace(
        frame,
        flow=solution.flow,
        confidence=confidence,
        trusted=solution.trusted and frame.trusted,
        reinitialised=solution.reinitialised,
        cpu_s=solution.cpu_s,
        wall_s=solution.wall_s,
        peak_bytes=solution.peak_bytes,
    )
