"""One worker process seen from the engine: starts it, gives it sequences, watches it, survives it."""

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import synth
from synth.system.stopwatch import ProgressCallback

Kind = Literal["done", "input", "error", "crash", "memory", "stalled", "disk", "stopped"]
"""How an attempt ended: only `done` is good; `input` would end the same way again."""

_TICK_S = 0.2
_LOG_TAIL = 4000


@dataclass(frozen=True)
class Attempt:
    """The end of one attempt at one sequence."""

    index: int
    kind: Kind
    reason: str = ""
    log: str = ""
    """Last lines that the process printed."""


@dataclass(frozen=True)
class Setup:
    """What every worker process of a run is started with."""

    job: Mapping[str, Any]
    """The job, JSON-ready, paths resolved."""
    folder: Path
    """The dataset; like all paths here absolute, for a worker stands elsewhere."""
    logs: Path
    scratch: Path
    """Where a process may leave what it likes."""
    work: str
    """`module:function` that computes a sequence: `(job, index, folder, report)`."""
    memory_bytes: int | None = None
    """A process that takes more is ended."""
    stall_s: float = 1800.0
    """A process that reports nothing for so long is ended."""
    keep_open: tuple[int, ...] = ()
    """File descriptors that live as long as any worker does: the lock of the dataset."""
    environment: Mapping[str, str] | None = None
    generator: str = ""
    """Version of the program that the engine has; a machine of a cluster with another one refuses."""
    turn: int = 0
    """Which run of the dataset this is; another number in `turn_file` says that it is over."""
    turn_file: Path = Path()


class Child:
    """A worker process. Not for use by several threads at once, but `kill` may come from another."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._pipe, theirs = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "synth.engine.worker", str(theirs)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(theirs, *setup.keep_open),
            env=_environment(setup.environment or {}),
            # Ctrl-C in the terminal is for the engine, which then ends its workers in order.
            start_new_session=True,
        )
        os.close(theirs)
        self._rest = b""
        self._ended = False
        self.finished = 0
        self._write(
            json.dumps(
                {
                    "job": setup.job,
                    "folder": str(setup.folder),
                    "logs": str(setup.logs),
                    "scratch": str(setup.scratch),
                    "work": setup.work,
                    "generator": setup.generator,
                }
            )
        )

    def run(self, index: int, report: ProgressCallback, stop: threading.Event) -> Attempt:
        """Computes one sequence; returns when it is sealed, has failed, or `stop` is set.

        After anything but "done" and "input" the process is gone.
        """
        self._write(str(index))
        heard = time.monotonic()
        while True:
            if stop.is_set():
                self.kill()
                return Attempt(index, "stopped")
            for message in self._messages():
                heard = time.monotonic()
                if "sealed" in message:
                    self.finished += 1
                    return Attempt(index, "done")
                if "failed" in message:
                    return Attempt(index, message["failed"], message["reason"], self._log(index))
                report(message["stage"], message["done"], message["of"])
            limit = self._setup.memory_bytes
            taken = self._memory()
            if limit is not None and taken > limit:
                self.kill()
                reason = f"took more than {limit / 1e9:.3g} GB of memory"
                return Attempt(index, "memory", reason, self._log(index))
            if time.monotonic() - heard > self._setup.stall_s:
                self.kill()
                reason = f"reported nothing for {self._setup.stall_s:.0f} s"
                return Attempt(index, "stalled", reason, self._log(index))
            if self._ended:
                return Attempt(index, "crash", _ending(self._process.returncode), self._log(index))

    def kill(self) -> None:
        """Ends the process and what it started, at once."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def close(self) -> None:
        """Ends the process and lets go of its pipes."""
        self.kill()
        with contextlib.suppress(BrokenPipeError):
            if self._process.stdin is not None:
                self._process.stdin.close()
        os.close(self._pipe)

    def _write(self, line: str) -> None:
        assert self._process.stdin is not None
        # A process that is gone is noticed, with its reason, by `run`.
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()

    def _messages(self) -> list[dict[str, Any]]:
        if not select.select([self._pipe], [], [], _TICK_S)[0]:
            return []
        text = os.read(self._pipe, 1 << 16)
        if not text:
            self._process.wait()
            self._ended = True
            return []
        *lines, self._rest = (self._rest + text).split(b"\n")
        return [json.loads(line) for line in lines]

    def _memory(self) -> int:
        try:
            pages = Path(f"/proc/{self._process.pid}/statm").read_text().split()
        except OSError:  # gone, or a system without /proc
            return 0
        return int(pages[1]) * os.sysconf("SC_PAGE_SIZE")

    def _log(self, index: int) -> str:
        path = self._setup.logs / f"{index:06d}.log"
        try:
            return path.read_text("utf-8", errors="replace")[-_LOG_TAIL:]
        except FileNotFoundError:
            return ""


def _environment(more: Mapping[str, str]) -> dict[str, str]:
    """One thread a numerical library: two slow each other down, and their number must not change a sum."""
    threads = ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "NUMBA", "BLOSC")
    found = {**os.environ, **{f"{name}_NUM_THREADS": "1" for name in threads}, "PYTHONHASHSEED": "0"}
    home = str(Path(synth.__file__).resolve().parents[1])
    found["PYTHONPATH"] = os.pathsep.join(filter(None, [home, found.get("PYTHONPATH", "")]))
    return {**found, **more}


def _ending(code: int) -> str:
    if code >= 0:
        return f"the process ended itself with code {code}"
    name = signal.Signals(-code).name
    hint = " (the system may have run out of memory)" if name == "SIGKILL" else ""
    return f"the process died of {name}{hint}"
