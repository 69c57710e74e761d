"""Flow in a process of its own: forces are computed from a frame's flow while the next frame's is.

A thread wouldn't do: the flow makes thousands of short calls a frame and would wait for the interpreter after
each (measured: two threads took longer than one).
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context, parent_process

from synth.flow.estimator import Flags, Rgb
from synth.flow.mask_selection import Proposal
from synth.recording_flow.frame_motion import FrameMotion
from synth.recording_flow.local_flow import LocalFlow


class FlowProcess(LocalFlow):
    """Flow in one other process, which starts at once and ends with this one."""

    ahead = 1

    def __init__(self) -> None:
        self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_set_up)
        # The other process inherits that Ctrl-C is held back: it is for this one, which closes the other.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._pool.submit(os.getpid)  # a first task starts it
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def begin(self, backend: str, rest: Rgb, proposal: Proposal, tissue: Flags) -> None:
        """See `LocalFlow`."""
        self._pool.submit(_begin, backend, rest, proposal, tissue).result()

    def submit(self, rgb: Rgb, proposal: Proposal) -> Future[FrameMotion]:
        """See `LocalFlow`."""
        return self._pool.submit(_step, rgb, proposal)

    def close(self) -> None:
        """Ends it, after the frame that it is at."""
        self._pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def open_flow_process() -> Iterator[FlowProcess | None]:
    """Another process for the flow, closed at the end; None where there is but one core."""
    if len(os.sched_getaffinity(0)) < 2:
        yield None
        return
    with contextlib.closing(FlowProcess()) as process:
        yield process


_flow = LocalFlow()
"""The other process's: it has one video at a time."""


def _set_up() -> None:
    from learn.training.threads import set_threads

    set_threads(None)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A pool's process waits for tasks for ever when the one that gives them is killed."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _begin(backend: str, rest: Rgb, proposal: Proposal, tissue: Flags) -> None:
    _flow.begin(backend, rest, proposal, tissue)


def _step(rgb: Rgb, proposal: Proposal) -> FrameMotion:
    frame = _flow.submit(rgb, proposal).result()
    return replace(frame, peak_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
