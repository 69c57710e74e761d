"""The cache of compiled and computed results between runs: private, writable folders of bounded size."""

from __future__ import annotations

import functools
import hashlib
import os
import stat
import tempfile
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TypeVar

from synth.system.checked_file import write_whole

T = TypeVar("T")

LIMIT_BYTES = 512 * 1024**2  # of the renderer's compiled kernels; the least recently used are deleted first


@functools.cache
def folder(name: str) -> Path:
    """The cache folder of that name: in `SULCUS_CACHE`, else in the user's cache, else in the temporary
    folder.

    Cached code is executed: where others own the folder or may write to it, it is `user-UID` inside. OSError:
    no folder is writable, or others own or may write to the user's own.
    """
    user, home = os.environ.get("XDG_CACHE_HOME"), os.environ.get("HOME")
    places = [Path(os.environ["SULCUS_CACHE"])] if "SULCUS_CACHE" in os.environ else []
    places += [Path(user or f"{home}/.cache") / "sulcus"] if user or home else []
    user_id = _user_id()
    temporary = Path(tempfile.gettempdir()) / f"sulcus-{user_id}"
    for parent in (
        *(candidate for place in places for candidate in (place, place / f"user-{user_id}")),
        temporary,
    ):
        with suppress(OSError):
            (parent / name).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            (parent / name).mkdir(mode=0o700, exist_ok=True)
            if all(is_private(candidate) for candidate in {parent / name, parent} - set(places)):
                return parent / name
    raise PermissionError(f"{temporary}: is not writable, or not by this user alone")


def _user_id() -> int:
    """Number of this user; 0 where users have none, as on Windows."""
    return int(getattr(os, "getuid", lambda: 0)())


def is_private(folder: Path) -> bool:
    """Whether a folder exists, is no link, and only this user may write to it."""
    with suppress(OSError):
        status = folder.lstat()
        is_own = status.st_uid == _user_id() and not status.st_mode & 0o022
        return stat.S_ISDIR(status.st_mode) and is_own and os.access(folder, os.W_OK)
    return False


def load_or_make(
    file: str,
    key: bytes,
    make: Callable[[], T],
    dump: Callable[[T], bytes],
    load: Callable[[bytes], T],
    faults: tuple[type[Exception], ...],
    most: int,
) -> T:
    """The result of `make`, from this user's cache if possible; concurrent calls of one key compute it once.

    `file`: folder and suffix in the cache, `compliance/npy`; `key`: all inputs of `make`; `faults`:
    exceptions of `load` for a corrupted file; `most`: number of files to store.
    """
    name, ending = file.split("/")
    word = hashlib.sha256(key).hexdigest()[:32]
    path = folder(name) / f"{word}.{ending}"
    with suppress(OSError, *faults):
        return load(path.read_bytes())
    with ExitStack() as locks:
        # Few locks, as they are never deleted; sharing one only costs time. Windows has none.
        with suppress(OSError, ImportError):
            import fcntl

            fcntl.flock(locks.enter_context((path.parent / f"{word[0]}.lock").open("w")), fcntl.LOCK_EX)
        with suppress(OSError, *faults):
            return load(path.read_bytes())
        result = make()
        with suppress(OSError):
            write_whole(path, dump(result), durable=False)
            entries = sorted(path.parent.glob(f"*.{ending}"), key=lambda entry: entry.stat().st_mtime)
            for entry in entries[:-most]:
                entry.unlink()
    return result
