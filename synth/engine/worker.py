"""The process that computes sequences, one after another, and says on a pipe how it goes.

Run as `python -m synth.engine.worker FD`, where FD is the pipe to write to. It reads lines of JSON from
standard input: first the setup, then one index at a time. What it and its libraries print
goes to the sequence's log.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import importlib
import json
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from synth.dataset import location
from synth.errors import UserError

# From <linux/prctl.h>: the signal this process gets when the engine dies, however it dies.
_PR_SET_PDEATHSIG = 1


def main(pipe: int) -> None:
    """Serves until standard input ends."""
    _die_with_parent()
    setup = json.loads(sys.stdin.readline())
    logs = Path(setup["logs"])
    # Libraries that drop files where they stand must not meet one another's, nor litter the user's folder.
    with tempfile.TemporaryDirectory(dir=setup["scratch"]) as scratch:
        os.chdir(scratch)
        _log_to(logs / f"worker-{os.getpid()}.log")
        _serve(pipe, setup, logs)


def _serve(pipe: int, setup: dict[str, Any], logs: Path) -> None:
    work = job = None
    settled = False
    for line in sys.stdin:
        index = int(line)
        log = logs / f"{index:06d}.log"
        _log_to(log)
        try:
            if location.store(Path(setup["folder"]), index).exists():
                # An attempt that a cluster lost sight of had just sealed it.
                log.unlink(missing_ok=True)
                _send(pipe, sealed=index)
                continue
            if work is None or job is None:
                _send(pipe, stage="start", done=0, of=1)
                _refuse_other_version(setup["generator"])
                work, job = _work(setup["work"]), _job(setup["job"])
            work(job, index, Path(setup["folder"]), _reporter(pipe))
        except UserError as error:
            _send(pipe, failed="input", reason=str(error))
        except OSError as error:
            traceback.print_exc()
            full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
            _send(pipe, failed="disk" if full else "error", reason=f"{type(error).__name__}: {error}")
        except MemoryError:
            traceback.print_exc()
            _send(pipe, failed="memory", reason="out of memory")
        except Exception as error:  # whatever it is, it costs this sequence and not the run
            traceback.print_exc()
            first = (str(error).splitlines() or [""])[0]
            _send(pipe, failed="error", reason=f"{type(error).__name__}: {first}")
        else:
            log.unlink(missing_ok=True)
            _send(pipe, sealed=index)
        gc.collect()
        if work is not None and not settled:
            # Libraries hold a million objects that never go: walking over them three times a sequence, in
            # search of what a scene left, took 0.7 s of it.
            gc.freeze()
            settled = True


def _refuse_other_version(expected: str) -> None:
    from synth.dataset import provenance

    if expected and provenance.fingerprint() != expected:
        raise UserError("the worker has another version of this program or its libraries than the engine")


def _job(described: dict[str, Any]) -> Any:
    from synth.job.schema import Job

    return Job.model_validate(described)


def _work(name: str) -> Callable[..., Any]:
    module, _, function = name.partition(":")
    work: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return work


def _reporter(pipe: int) -> Callable[[str, int, int], None]:
    def report(stage: str, done: int, of: int) -> None:
        _send(pipe, stage=stage, done=done, of=of)

    return report


def _send(pipe: int, **message: Any) -> None:
    os.write(pipe, json.dumps(message).encode() + b"\n")


def _log_to(path: Path) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o644)
    os.dup2(file, 1)
    os.dup2(file, 2)
    os.close(file)


def _die_with_parent() -> None:
    parent = os.getppid()
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
        # When memory runs out, the kernel is to take this process and not the engine.
        Path("/proc/self/oom_score_adj").write_text("800")


if __name__ == "__main__":
    main(int(sys.argv[1]))
