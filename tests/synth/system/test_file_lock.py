"""The lock of a dataset on a file system that has none: two runs still exclude each other."""

import errno
import fcntl
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from synth.system import file_lock

HOLD = """
import errno, fcntl, pathlib, sys, time
def refuse(*_):
    raise OSError(errno.ENOLCK, "No locks available")
fcntl.flock = refuse
from synth.system import file_lock
with file_lock.hold(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_a_file_system_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    lock = tmp_path / "lock"
    command = [sys.executable, "-c", HOLD, str(lock)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        assert file_lock.is_held(lock)
        monkeypatch.setattr(file_lock, "_WAIT_S", 0.2 - file_lock._LEASE_S)
        with pytest.raises(file_lock.Locked), file_lock.hold(lock):
            pass
        process.kill()
    monkeypatch.setattr(file_lock, "_WAIT_S", 5)
    begin_s = time.monotonic()
    with file_lock.hold(lock):  # a dead process's lease is not waited for
        assert time.monotonic() - begin_s < 10
        assert file_lock.is_held(lock)
    assert not file_lock.is_held(lock)


def test_a_lease_excludes_a_machine_with_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_lock, "_WAIT_S", 0.2)
    lease = tmp_path / "lock.lease"
    lease.touch()
    with pytest.raises(file_lock.Locked), file_lock.hold(tmp_path / "lock"):
        pass
    os.utime(lease, (0, 0))  # left behind long ago
    with file_lock.hold(tmp_path / "lock"):
        assert file_lock.is_held(tmp_path / "lock")
