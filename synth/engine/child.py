"""The engine's side of a worker process: its resources, its start, its sequences, and its replacement."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import synth
from synth.dataset.dataset_folder import Folder
from synth.errors import UserError
from synth.job.schema import Job
from synth.system import gpu, llvm, resources
from synth.system.stopwatch import StageCallback

Kind = Literal["done", "input", "error", "crash", "memory", "stalled", "disk", "stopped"]
"""Outcome of an attempt: `done` is the only success; `input` would fail the same way again."""

_TICK_S = 0.2
_STALL_S = 1800.0  # a process without a report for so long is killed
_LOG_TAIL = 4000  # characters
# In case a library leaks memory; none did so in 16 sequences. A start takes as long as half a sequence.
_SEQUENCES_PER_PROCESS = 128


@dataclass(frozen=True)
class Attempt:
    """The result of one attempt at one sequence."""

    index: int
    kind: Kind
    reason: str = ""
    log: str = ""  # last lines printed by the process


@dataclass(frozen=True)
class Setup:
    """Settings of all worker processes of a run."""

    job: Mapping[str, Any]  # the job, JSON-ready, paths resolved
    folder: Path  # the dataset; absolute, as workers have another working directory
    work: str  # `module:function` that computes a sequence: `(job, index, folder, report)`
    memory_bytes: int | None = None  # limit of a process
    lock_fd: int | None = None  # the dataset's lock, inherited so that it is held until all workers end
    environment: Mapping[str, str] = field(default_factory=dict)  # added to that of the engine
    generator: str = ""  # the engine's version of the program; a cluster's machine with another one refuses
    turn: int = 0  # number of this run of the dataset; it is over when the folder's has another number


class Child:
    """A worker process for one sequence at a time, started when needed and replaced when used up or dead."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._process: subprocess.Popen[bytes] | None = None

    def run(self, index: int, report: StageCallback, stop: threading.Event) -> Attempt:
        """Computes a sequence until it is sealed, has failed, or `stop` is set; faults end the process."""
        if self._process is None:
            self._process = self._start()
        attempt = self._attempt(self._process, index, report, stop)
        self._finished += attempt.kind == "done"
        if attempt.kind not in ("done", "input") or self._finished >= _SEQUENCES_PER_PROCESS:
            self.close()
        return attempt

    def close(self) -> None:
        """Kills the process and those that it started, and closes its pipes."""
        if self._process is None or self._process.stdin is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        os.close(self._pipe)
        self._process = None

    def _start(self) -> subprocess.Popen[bytes]:
        self._pipe, child_end = os.pipe()
        lock = self._setup.lock_fd
        process = subprocess.Popen(
            [sys.executable, "-m", "synth.engine.worker", str(child_end)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(child_end,) if lock is None else (child_end, lock),
            env={**os.environ, **self._setup.environment},
            # Ctrl-C in the terminal goes to the engine only, which then ends its workers in order.
            start_new_session=True,
        )
        os.close(child_end)
        self._unread, self._finished = b"", 0
        _write(process, json.dumps(asdict(self._setup), default=str))
        return process

    def _attempt(
        self, process: subprocess.Popen[bytes], index: int, report: StageCallback, stop: threading.Event
    ) -> Attempt:
        _write(process, str(index))
        last = time.monotonic()
        limit = self._setup.memory_bytes
        while not stop.is_set():
            messages = self._read()
            for message in messages or ():
                last = time.monotonic()
                if "sealed" in message:
                    return Attempt(index, "done")
                if "failed" in message:
                    return Attempt(index, message["failed"], message["reason"], self._log(index))
                report(message["stage"], message["done"], message["of"])
            if messages is None:
                return Attempt(index, "crash", _describe_exit(process.wait()), self._log(index))
            if limit is not None and _memory(process.pid) > limit:
                reason = f"used more than {limit / 1e9:.3g} GB of memory"
                return Attempt(index, "memory", reason, self._log(index))
            if time.monotonic() - last > _STALL_S:
                return Attempt(index, "stalled", f"reported nothing for {_STALL_S:.0f} s", self._log(index))
        return Attempt(index, "stopped")

    def _read(self) -> list[dict[str, Any]] | None:
        """Messages of the process within a tick; None if it has ended."""
        if not select.select([self._pipe], [], [], _TICK_S)[0]:
            return []
        text = os.read(self._pipe, 1 << 16)
        *lines, self._unread = (self._unread + text).split(b"\n")
        return [json.loads(line) for line in lines] if text else None

    def _log(self, index: int) -> str:
        with contextlib.suppress(FileNotFoundError):
            log = Folder(self._setup.folder).logs / f"{index:06d}.log"
            return log.read_text("utf-8", errors="replace")[-_LOG_TAIL:]
        return ""


def _write(process: subprocess.Popen[bytes], line: str) -> None:
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):  # `run` detects a dead process and its reason
        process.stdin.write(line.encode() + b"\n")
        process.stdin.flush()


def _memory(pid: int) -> int:
    with contextlib.suppress(OSError):  # it has ended
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def _describe_exit(code: int) -> str:
    if code >= 0:
        return f"the process exited with code {code}"
    name = signal.Signals(-code).name
    hint = " (the system may have run out of memory)" if name == "SIGKILL" else ""
    return f"the process died of {name}{hint}"


def choose_gpus(option: str, needed: bool) -> tuple[str, ...] | None:
    """Names of the GPUs that workers share, for CUDA_VISIBLE_DEVICES; None: it is not set.

    `option`: `auto` (only if `needed`), `none` or names separated by commas. UserError for a GPU not there.
    """
    if option == "none":
        return ()
    if option == "auto":
        return (gpu.visible() or None) if needed else None
    names, available = tuple(word.strip() for word in option.split(",")), gpu.visible()
    if missing := [name for name in names if name not in available]:
        raise UserError(f"--gpus {', '.join(missing)}: this machine has {', '.join(available) or 'none'}")
    return names


def environment(job: Job, workers: int) -> dict[str, str]:
    """What all workers of a machine have in their environment: threads, the program, the renderer's LLVM."""
    threads = max(1, resources.cores() // workers)
    library = llvm.find() if job.render.variant in ("auto", "llvm_ad_rgb") else None
    home = str(Path(synth.__file__).resolve().parents[1])
    path = os.pathsep.join(filter(None, [home, os.environ.get("PYTHONPATH", "")]))
    variables = {"SULCUS_THREADS": str(threads), "SULCUS_LLVM": library or "", "PYTHONPATH": path}
    # One thread per numerical library: more slow each other down, and their number must not change a sum.
    libraries = ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "NUMBA", "BLOSC")
    return {**variables, "PYTHONHASHSEED": "0", **{f"{name}_NUM_THREADS": "1" for name in libraries}}


def share_of_memory(workers: int) -> int:
    """Bytes of the free memory, as control groups limit it, for each of `workers` processes."""
    free = resources.free_memory()
    if free is None:
        raise UserError("the free memory is unknown on this system: give --memory in GB")
    return int(0.9 * free / workers)
