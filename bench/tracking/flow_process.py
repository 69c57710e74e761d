"""Flow in a process of its own: what is asked of a frame's flow runs while the next frame's is computed.

A thread wouldn't do: the flow makes thousands of short calls a frame and would wait for the interpreter after
each (measured: two threads took longer than one).
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context, parent_process
from typing import TypeVar

from synth.errors import UserError
from synth.flow.mask_choice import Proposal
from synth.recording_flow.video_flow import Asked, Flags, FlowHere, Found, Rgb

T = TypeVar("T")


class FlowProcess(FlowHere):
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

    def begin(self, backend: str, rest: Rgb, blocked: Flags | Proposal, tissue: Flags) -> None:
        """See `FlowHere`."""
        _result(self._submit(_begin, backend, rest, blocked, tissue))

    def ask(self, rgb: Rgb, blocked: Flags | Proposal) -> Asked:
        """See `FlowHere`."""
        future = self._submit(_step, rgb, blocked)
        return Asked(lambda: _result(future), lambda within_s: bool(wait([future], within_s).done))

    def close(self) -> None:
        """Ends it, after the frame that it is at."""
        self._pool.shutdown(cancel_futures=True)

    def _submit(self, task: Callable[..., T], *given: object) -> Future[T]:
        try:
            return self._pool.submit(task, *given)
        except BrokenProcessPool:
            raise _gone() from None


@contextlib.contextmanager
def elsewhere() -> Iterator[FlowProcess | None]:
    """Another process for the flow, closed at the end; None where there is but one core."""
    if len(os.sched_getaffinity(0)) < 2:
        yield None
        return
    with contextlib.closing(FlowProcess()) as process:
        yield process


def _result(future: Future[T]) -> T:
    try:
        return future.result()
    except BrokenProcessPool:
        raise _gone() from None


def _gone() -> UserError:
    return UserError("the process that computes the flow ended; out of memory?")


_flow = FlowHere()
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


def _begin(backend: str, rest: Rgb, blocked: Flags | Proposal, tissue: Flags) -> None:
    _flow.begin(backend, rest, blocked, tissue)


def _step(rgb: Rgb, blocked: Flags | Proposal) -> Found:
    found = _flow.ask(rgb, blocked)()
    return replace(found, peak_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
