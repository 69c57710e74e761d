"""Flow in a process of its own: what is asked of a frame's flow runs while the next frame's is computed.

A thread wouldn't do: the flow makes thousands of short calls a frame and would wait for the interpreter after
each (measured: two threads took longer than one).
"""

from __future__ import annotations

import resource
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.flow.track import Tracker

Rgb = NDArray[np.uint8]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Found:
    """The flow of one frame."""

    flow: NDArray[np.float32]
    """(H, W, 2) px from the rest frame."""
    confidence: NDArray[np.float32]
    """(H, W)."""
    cpu_s: float
    wall_s: float
    peak_bytes: int
    """Memory of the other process; 0 without one."""


class Flow(Protocol):
    """Frames in order; one at a time is under way."""

    def begin(self, backend: str, rest: Rgb, blocked: Flags, tissue: Flags) -> None:
        """The rest frame; arguments and errors as `Tracker`."""

    def ask(self, rgb: Rgb, blocked: Flags) -> None:
        """Gives a frame: (H, W, 3) and (H, W)."""

    def answer(self) -> Found:
        """The flow of the frame given last; errors as `Tracker.step`."""
        ...

    def close(self) -> None:
        """Ends it, whatever it is doing."""


class Here:
    """Flow in this process."""

    def begin(self, backend: str, rest: Rgb, blocked: Flags, tissue: Flags) -> None:
        """See `Flow`."""
        self._tracker = Tracker(backend, rest, blocked, tissue)

    def ask(self, rgb: Rgb, blocked: Flags) -> None:
        """See `Flow`."""
        cpu, wall = time.process_time(), time.perf_counter()
        flow, confidence = self._tracker.step(rgb, blocked)
        spent = time.process_time() - cpu, time.perf_counter() - wall
        self._found = Found(flow, confidence, *spent, 0)

    def answer(self) -> Found:
        """See `Flow`."""
        return self._found

    def close(self) -> None:
        """See `Flow`."""


class Beside:
    """Flow in a process of its own, which starts at once and ends with this one."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "bench.tracking.flow_process", str(theirs.fileno())],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for this process, which then closes the other
            )
        self._line = Connection(ours.detach())

    def begin(self, backend: str, rest: Rgb, blocked: Flags, tissue: Flags) -> None:
        """See `Flow`."""
        self._send((backend, rest, blocked, tissue))
        self._receive()

    def ask(self, rgb: Rgb, blocked: Flags) -> None:
        """See `Flow`."""
        self._send((rgb, blocked))

    def answer(self) -> Found:
        """See `Flow`."""
        found = self._receive()
        assert isinstance(found, Found)
        return found

    def close(self) -> None:
        """See `Flow`."""
        self._process.kill()
        self._process.wait()
        self._line.close()

    def _send(self, what: object) -> None:
        try:
            self._line.send(what)
        except OSError as error:
            raise self._gone() from error

    def _receive(self) -> object:
        try:
            said = self._line.recv()
        except (EOFError, OSError) as error:
            raise self._gone() from error
        if isinstance(said, Exception):
            raise said
        return said

    def _gone(self) -> UserError:
        self._process.wait()
        return UserError(
            f"the process that computes the flow ended (status {self._process.returncode}); out of memory?"
        )


def serve(line: Connection) -> None:
    """What the other process does: answers until nobody asks."""
    here = Here()
    beginning = True
    while True:
        try:
            said = line.recv()
        except (EOFError, OSError):  # the other side is gone, perhaps in the middle of a word
            return
        try:
            if beginning:
                here.begin(*said)
                beginning, answer = False, None
            else:
                here.ask(*said)
                found = here.answer()
                peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
                answer = Found(found.flow, found.confidence, found.cpu_s, found.wall_s, peak)
        except Exception as error:
            # Whatever it is, it is raised again where the frame came from.
            line.send(error)
        else:
            line.send(answer)


if __name__ == "__main__":
    from bench.tracking.flow_process import (
        serve as _serve,  # as the module that the other side knows, not as __main__
    )
    from learn.training.threads import set_threads

    set_threads(None)
    _serve(Connection(int(sys.argv[1])))
