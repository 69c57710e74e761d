"""The cache of compiled and computed results between runs: private, writable folders of bounded size."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from synth.system.checked_file import write_whole

T = TypeVar("T")

LIMIT_BYTES = 512 * 1024**2  # of the renderer's compiled kernels; the least recently used are deleted first


@functools.cache
def folder(name: str) -> Path:
    """The cache folder of that name, created if necessary.

    It is in `SULCUS_CACHE`, else in the user's cache (`XDG_CACHE_HOME`, else ~/.cache); if neither is
    writable (no home, read-only), in a private folder of this user in the system's temporary one.

    Raises:
        OSError: no folder is writable, or others own or may write to the temporary one: cached code is
        executed.
    """
    user, home = os.environ.get("XDG_CACHE_HOME"), os.environ.get("HOME")
    places = [
        Path(os.environ["SULCUS_CACHE"]) if "SULCUS_CACHE" in os.environ else None,
        Path(user) / "sulcus" if user else Path(home) / ".cache" / "sulcus" if home else None,
    ]
    for place in filter(None, places):
        try:
            (place / name).mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(place / name, os.W_OK):
            return place / name
    mine = Path(tempfile.gettempdir()) / f"sulcus-{os.getuid()}"
    mine.mkdir(mode=0o700, exist_ok=True)
    about = mine.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o077:
        raise PermissionError(f"{mine}: is not this user's alone")
    (mine / name).mkdir(exist_ok=True)
    return mine / name


def cached(
    file: str,
    key: bytes,
    make: Callable[[], T],
    dump: Callable[[T], bytes],
    load: Callable[[bytes], T],
    faults: tuple[type[Exception], ...],
    most: int,
) -> T:
    """The result of `make`, from this user's cache if possible; concurrent calls of one key compute it once.

    Args:
        file: folder and suffix in the cache, `compliance/npy`.
        key: identifies all inputs of `make`.
        make: computes the result.
        dump: encodes it as the bytes of a file.
        load: decodes these.
        faults: exceptions of `load` for a truncated or corrupted file.
        most: number of files to store; older ones are deleted.
    """
    name, ending = file.split("/")
    word = hashlib.sha256(key).hexdigest()[:32]
    place = folder(name) / f"{word}.{ending}"
    with contextlib.suppress(OSError, *faults):
        return load(place.read_bytes())
    with contextlib.ExitStack() as held:
        with contextlib.suppress(
            OSError
        ):  # few locks, as they are never deleted; sharing one only costs time
            fcntl.flock(held.enter_context((place.parent / f"{word[0]}.lock").open("w")), fcntl.LOCK_EX)
        with contextlib.suppress(OSError, *faults):
            return load(place.read_bytes())
        made = make()
        with contextlib.suppress(OSError):
            write_whole(place, dump(made), durable=False)
            for old in sorted(place.parent.glob(f"*.{ending}"), key=lambda one: one.stat().st_mtime)[:-most]:
                old.unlink()
    return made
