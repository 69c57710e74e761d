"""Flow in another process, which works on the next frame while forces of the current one are computed.

Threads are no alternative: flow makes thousands of short calls per frame and would wait for the interpreter
after each (two threads take longer than one).
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context, parent_process

from synth.arrays import Mask, Pixels
from synth.flow.mask_selection import Proposal
from synth.recording_flow.flow import LocalFlow
from synth.recording_flow.frame_motion import FrameMotion


class FlowProcess(LocalFlow):
    """Flow in another process, which starts at once and ends with this one."""

    ahead = 1

    def __init__(self, set_up: Callable[[], object]) -> None:
        """`set_up`: called in the process before anything else."""
        spawn = get_context("spawn")
        self._pool = ProcessPoolExecutor(1, mp_context=spawn, initializer=_begin_process, initargs=(set_up,))
        # The other process inherits the blocked SIGINT: on Ctrl-C this process closes it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._pool.submit(os.getpid)  # the first task starts the process
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def begin(self, backend: str, rest: Pixels, proposal: Proposal, tissue: Mask) -> None:
        """See `LocalFlow`."""
        self._pool.submit(_begin, backend, rest, proposal, tissue).result()

    def submit(self, rgb: Pixels, proposal: Proposal) -> Future[FrameMotion]:
        """See `LocalFlow`."""
        return self._pool.submit(_step, rgb, proposal)

    def close(self) -> None:
        """Ends the process after its current frame."""
        self._pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def open_flow_process(set_up: Callable[[], object]) -> Iterator[FlowProcess | None]:
    """A process for flow, which calls `set_up` first, closed at the end; None on a single core."""
    if len(os.sched_getaffinity(0)) < 2:
        yield None
        return
    with contextlib.closing(FlowProcess(set_up)) as process:
        yield process


_flow = LocalFlow()  # of the other process, for one video at a time


def _begin_process(set_up: Callable[[], object]) -> None:
    set_up()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Ends the process with its parent, which when killed would leave it waiting for tasks."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _begin(backend: str, rest: Pixels, proposal: Proposal, tissue: Mask) -> None:
    _flow.begin(backend, rest, proposal, tissue)


def _step(rgb: Pixels, proposal: Proposal) -> FrameMotion:
    frame = _flow.submit(rgb, proposal).result()
    return replace(frame, peak_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
