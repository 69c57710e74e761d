"""Workers of the engine that start in milliseconds: forked from one process that has made their imports.

The engine's tests start dozens of workers, and each would import pydantic, OpenCV and Zarr for a second. A
forked worker runs the same `synth.engine.worker.main` in a process and session of its own, with its pipes.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

_HERE = Path(__file__).resolve().parent


class Forkserver:
    """The process that forks workers. `subprocess` stands in for the module of that name in the engine."""

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        path = os.pathsep.join([str(_HERE), str(_HERE.parents[1]), os.environ.get("PYTHONPATH", "")])
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"import forked_workers; forked_workers.serve({theirs.fileno()})"],
            pass_fds=[theirs.fileno()],
            env={**os.environ, "PYTHONPATH": path},
        )
        theirs.close()
        self.subprocess = SimpleNamespace(Popen=self._start, PIPE=subprocess.PIPE, DEVNULL=subprocess.DEVNULL)

    def _start(
        self, words: Sequence[str], *, pass_fds: Sequence[int], env: Mapping[str, str], **_: Any
    ) -> Worker:
        assert words[1:3] == ["-m", "synth.engine.worker"], "only workers of the engine are forked"
        read, write = os.pipe()
        status, theirs = socket.socketpair()
        # The report's pipe comes first in `pass_fds`; a lock is only held.
        fds = [theirs.fileno(), read, *pass_fds]
        socket.send_fds(self._socket, [json.dumps(dict(env)).encode()], fds)
        os.close(read)
        theirs.close()
        return Worker(status, os.fdopen(write, "wb"))

    def close(self) -> None:
        """Ends the process."""
        self._socket.close()
        self._process.wait()


class Worker:
    """A forked worker, with what the engine uses of `subprocess.Popen`."""

    def __init__(self, status: socket.socket, stdin: Any) -> None:
        self._status, self.stdin = status, stdin
        self._lines = status.makefile()
        self.pid = int(self._lines.readline())
        self._code: int | None = None

    def wait(self) -> int:
        """Waits for the end; returns the exit code, negative for a signal."""
        if self._code is None:
            self._code = int(self._lines.readline())
            self._lines.close()
            self._status.close()
        return self._code


def serve(fd: int) -> None:
    """Forks a worker for every request, until the socket's other end is closed."""
    import fake_work  # noqa: F401

    import synth.engine.worker  # noqa: F401

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # keepers are not waited for
    with socket.socket(fileno=fd) as requests:
        while True:
            text, fds, _, _ = socket.recv_fds(requests, 1 << 17, 8)
            if not text:
                return
            if not os.fork():
                requests.close()
                _keep(json.loads(text), fds)
            for worker_fd in fds:
                os.close(worker_fd)


def _keep(environment: dict[str, str], fds: list[int]) -> None:
    """Forks the worker, reports its exit code when it ends, and ends."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    status, stdin, report, *_ = fds
    worker = os.fork()
    if not worker:
        _work(environment, status, stdin, report)
    for fd in fds[1:]:
        os.close(fd)
    code = os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1])
    with contextlib.suppress(BrokenPipeError):
        os.write(status, f"{code}\n".encode())
    os._exit(0)


def _work(environment: dict[str, str], status: int, stdin: int, report: int) -> None:
    """The worker itself; it never returns."""
    from synth.engine import worker

    code = 1
    try:
        os.setsid()
        os.dup2(stdin, 0)
        os.close(stdin)
        sys.stdin = os.fdopen(0)
        os.environ.clear()
        os.environ.update(environment)
        os.write(status, f"{os.getpid()}\n".encode())  # only now: the engine kills its process group
        os.close(status)
        worker.main(report)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)
