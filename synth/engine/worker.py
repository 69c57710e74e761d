"""The process that computes sequences: `python -m synth.engine.worker FD`, which reports on the pipe FD.

It reads JSON lines: the setup, then one index at a time. All that is printed goes to the sequence's log.
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
from functools import partial
from pathlib import Path
from typing import Any

from synth.dataset import location
from synth.dataset.dataset_folder import Folder
from synth.errors import UserError

_PR_SET_PDEATHSIG = 1  # <linux/prctl.h>: the signal sent to this process when the engine dies


def main(pipe: int) -> None:
    """Computes sequences until standard input ends."""
    _die_with_parent()
    setup = json.loads(sys.stdin.readline())
    folder = Folder(Path(setup["folder"]))
    # Libraries that write files to the working directory must not share it, nor use the user's folder.
    with tempfile.TemporaryDirectory(dir=folder.scratch) as scratch:
        os.chdir(scratch)
        _log_to(folder.logs / f"worker-{os.getpid()}.log")
        _serve(pipe, setup, folder)


def _serve(pipe: int, setup: dict[str, Any], folder: Folder) -> None:
    render, frozen = None, False
    for line in sys.stdin:
        index = int(line)
        log = folder.logs / f"{index:06d}.log"
        _log_to(log)
        try:
            # It exists already if a cluster lost the result of an attempt that had just sealed it.
            if not location.store(folder.root, index).exists():
                if render is None:
                    _send(pipe, stage="start", done=0, of=1)
                    render = _prepare(setup)
                render(index, folder.root, lambda stage, done, of: _send(pipe, stage=stage, done=done, of=of))
        except UserError as error:
            _send(pipe, failed="input", reason=str(error))
        except Exception as error:  # any error fails this sequence only, not the run
            traceback.print_exc()
            disk_full = isinstance(error, OSError) and error.errno in (
                errno.ENOSPC,
                errno.EDQUOT,
                errno.EROFS,
            )
            kind, message = "disk" if disk_full else "error", (str(error).splitlines() or [""])[0]
            if isinstance(error, MemoryError):
                kind, message = "memory", "out of memory"
            _send(pipe, failed=kind, reason=f"{type(error).__name__}: {message}")
        else:
            log.unlink(missing_ok=True)
            _send(pipe, sealed=index)
        gc.collect()
        if render is not None and not frozen:
            gc.freeze()  # libraries hold a million permanent objects, whose scanning took 0.7 s a sequence
            frozen = True


def _prepare(setup: dict[str, Any]) -> Callable[..., None]:
    """The function that computes a sequence of the job. UserError if the engine has another version."""
    from synth.dataset import provenance
    from synth.job.schema import Job

    if setup["generator"] and provenance.fingerprint() != setup["generator"]:
        raise UserError("the worker has another version of this program or its libraries than the engine")
    module, _, function = setup["work"].partition(":")
    return partial(getattr(importlib.import_module(module), function), Job.model_validate(setup["job"]))


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
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    # If memory runs out, the kernel shall kill this process and not the engine.
    Path("/proc/self/oom_score_adj").write_text("800")


if __name__ == "__main__":
    main(int(sys.argv[1]))
