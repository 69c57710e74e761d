"""Where sequences are computed, one at a time each: here, by worker processes that are replaced when worn."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Protocol

from synth import llvm
from synth.child import Attempt, Child, Setup
from synth.job import Job

Report = Callable[[str, int, int], None]

# A process that has computed so many is replaced: libraries leak a little with every sequence.
_RECYCLE = 16


class Slot(Protocol):
    """Computes one sequence at a time; the engine has a thread for every slot."""

    def run(self, index: int, report: Report, stop: threading.Event) -> Attempt: ...
    def close(self) -> None: ...


class Slots(Protocol):
    """Makes the slots of a run."""

    def count(self) -> int: ...
    def slot(self) -> Slot: ...


class LocalSlot:
    """A worker process on this machine."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._child: Child | None = None

    def run(self, index: int, report: Report, stop: threading.Event) -> Attempt:
        self._child = self._child or Child(self._setup)
        attempt = self._child.run(index, report, stop)
        if attempt.kind not in ("done", "input") or self._child.finished >= _RECYCLE:
            self.close()
        return attempt

    def close(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None


class LocalSlots:
    """As many slots on this machine as asked for."""

    def __init__(self, setup: Setup, workers: int) -> None:
        self._setup, self._workers = setup, workers

    def count(self) -> int:
        return self._workers

    def slot(self) -> Slot:
        return LocalSlot(self._setup)


def local(setup: Setup, workers: int) -> AbstractContextManager[Slots]:
    """Slots on this machine, for as long as the context lasts."""
    return nullcontext(LocalSlots(setup, workers))


def machine(job: Job, workers: int) -> dict[str, str]:
    """What is found out once for all workers of a machine: threads for each, and the renderer's LLVM."""
    threads = max(1, len(os.sched_getaffinity(0)) // workers)
    library = llvm.find() if job.render.variant in ("auto", "llvm_ad_rgb") else None
    return {"SULCUS_THREADS": str(threads), "SULCUS_LLVM": library or ""}


def share_of_memory(workers: int) -> int | None:
    """Bytes that each of `workers` processes may take of what is available now; None if that is not known."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:  # a system without /proc: its own limits must do
        return None
    fields = dict(line.split(":") for line in lines)
    return int(0.9 * int(fields["MemAvailable"].split()[0]) * 1024 / workers)
