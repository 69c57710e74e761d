"""Where sequences are computed, one at a time each: here, by worker processes that are replaced when worn."""

from __future__ import annotations

import itertools
import os
import subprocess
import threading
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from synth.engine.worker_process import Attempt, Child, Setup
from synth.errors import UserError
from synth.job.schema import Job
from synth.system import llvm
from synth.system.stopwatch import ProgressCallback

# A process that has computed so many is replaced, should a library leak: none was seen to, over 16 sequences
# (731 MB after the last, 736 after the second); starting anew costs what half a sequence does.
SEQUENCES_A_PROCESS = 128


class Slot(Protocol):
    """Computes one sequence at a time; the engine has a thread for every slot."""

    def run(self, index: int, report: ProgressCallback, stop: threading.Event) -> Attempt: ...
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

    def run(self, index: int, report: ProgressCallback, stop: threading.Event) -> Attempt:
        self._child = self._child or Child(self._setup)
        attempt = self._child.run(index, report, stop)
        if attempt.kind not in ("done", "input") or self._child.finished >= SEQUENCES_A_PROCESS:
            self.close()
        return attempt

    def close(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None


class LocalSlots:
    """As many slots on this machine as asked for; each sees one of `gpus` in turn, or those that it finds."""

    def __init__(self, setup: Setup, workers: int, gpus: tuple[str, ...] | None) -> None:
        self._setup, self._workers, self._gpus = setup, workers, gpus
        self._made = itertools.count()

    def count(self) -> int:
        return self._workers

    def slot(self) -> Slot:
        if self._gpus is None:
            return LocalSlot(self._setup)
        mine = self._gpus[next(self._made) % len(self._gpus)] if self._gpus else ""
        seen = {**(self._setup.environment or {}), "CUDA_VISIBLE_DEVICES": mine}
        return LocalSlot(replace(self._setup, environment=seen))


def gpus(asked: str, wanted: bool) -> tuple[str, ...] | None:
    """Names of the GPUs that workers share, as CUDA_VISIBLE_DEVICES takes them; None: nothing is set.

    Args:
        asked: `auto`, `none` or names with commas between.
        wanted: whether the job renders on a GPU; else `auto` sets nothing.

    Raises:
        UserError: a GPU that is not there.
    """
    if asked == "none":
        return ()
    if asked == "auto":
        return (_gpus_here() or None) if wanted else None
    named, here = tuple(word.strip() for word in asked.split(",")), _gpus_here()
    strangers = [name for name in named if name not in here]
    if strangers:
        raise UserError(f"--gpus {', '.join(strangers)}: this machine has {', '.join(here) or 'none'}")
    return named


def _gpus_here() -> tuple[str, ...]:
    """What a scheduler left visible, or all."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(name.strip() for name in visible.split(",") if name.strip())
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):  # no driver, or one that does not answer
        return ()
    count = sum(line.startswith("GPU ") for line in listed.stdout.splitlines())
    return tuple(str(k) for k in range(count)) if listed.returncode == 0 else ()


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
