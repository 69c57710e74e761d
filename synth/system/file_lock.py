"""Exclusion of other processes by a locked file, also on file systems without locks (some Lustre and NFS)."""

from __future__ import annotations

import errno
import fcntl
import os
import time
from _thread import interrupt_main
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from synth.errors import UserError
from synth.system.checked_file import open_file

_NONE = errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP
_WAIT_S = 5.0
_LEASE_S = 30.0  # after which a silent process of another machine has ended; refreshed three times as often


class Locked(Exception):
    """Another process holds the lock."""


@contextmanager
def hold(path: Path, wait_s: float | None = None) -> Iterator[int]:
    """Holds the lock of a file, which is created; yields its descriptor, by which child processes hold it
    too.

    Without locks of the file system a file next to it is refreshed: a dead process's is taken at once,
    another machine's after half a minute; machines with locks see it, but not the other way round. If it is
    lost, as after a suspension, this process is interrupted. Raises `Locked` after some seconds, or `wait_s`.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    wait_s = _WAIT_S if wait_s is None else wait_s
    until = time.monotonic() + wait_s
    try:
        while (locked := _try_lock(descriptor, fcntl.LOCK_EX)) is False or (locked and _is_leased(path)):
            if time.monotonic() > until:
                raise Locked
            time.sleep(0.1)
        if locked:
            yield descriptor
            return
        from filelock import SoftFileLease, Timeout

        lease = SoftFileLease(
            _lease(path), lease_duration=_LEASE_S, on_compromise=lambda lost: interrupt_main()
        )
        try:
            lease.acquire(timeout=_LEASE_S + wait_s)
        except Timeout:
            raise Locked from None
        try:
            yield descriptor
        finally:
            lease.release()
    finally:
        os.close(descriptor)


def is_held(path: Path) -> bool:
    """Whether a process holds the lock of a file; one that ended without notice counts for a minute."""
    with suppress(UserError), open_file(path, 1 << 20) as file:
        return _try_lock(file.fileno(), fcntl.LOCK_SH) is False or _is_leased(path)
    return False


def _try_lock(descriptor: int, operation: int) -> bool | None:
    """Whether the lock was free and is now held; None where the file system has none."""
    try:
        fcntl.flock(descriptor, operation | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in _NONE:
            return None
        raise
    return True


def _lease(path: Path) -> Path:
    return path.with_name(f"{path.name}.lease")


def _is_leased(path: Path) -> bool:
    """Whether a machine without locks has refreshed its lease lately, by the clock of this one."""
    with suppress(FileNotFoundError):
        return time.time() - _lease(path).stat().st_mtime < 2 * _LEASE_S
    return False
