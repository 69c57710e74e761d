"""What is kept between runs, compiled or computed: folders of our own, bounded, that can be written."""

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

LIMIT_BYTES = 512 * 1024**2
"""What the renderer's compiled kernels may take; the least recently used go first."""


@functools.cache
def folder(name: str) -> Path:
    """A folder for one kind of compiled code, made if it isn't there.

    `SULCUS_CACHE` is asked first, then the user's cache (`XDG_CACHE_HOME`, else ~/.cache); where neither can
    be written (no home, read-only), a folder of this user's own in the system's temporary one.

    Raises:
        OSError: nothing can be written, or the temporary folder is one that others made or may write to: what
            is kept here is code that will be run.
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


def kept(
    file: str,
    key: bytes,
    make: Callable[[], T],
    dump: Callable[[T], bytes],
    load: Callable[[bytes], T],
    faults: tuple[type[Exception], ...],
    most: int,
) -> T:
    """What `make` gives, from this user's cache if it was made before; who wants what is being made waits.

    Args:
        file: folder and ending, `compliance/npy`.
        key: of all that it is made of.
        make: computes it.
        dump: to the bytes of a file.
        load: of these.
        faults: what `load` raises of half a file, of a disk that was full, or one that others wrote.
        most: files that are kept, the newest.
    """
    name, ending = file.split("/")
    word = hashlib.sha256(key).hexdigest()[:32]
    place = folder(name) / f"{word}.{ending}"
    with contextlib.suppress(OSError, *faults):
        return load(place.read_bytes())
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):  # few locks, for they stay; two that share one only wait longer
            fcntl.flock(held.enter_context((place.parent / f"{word[0]}.lock").open("w")), fcntl.LOCK_EX)
        with contextlib.suppress(OSError, *faults):
            return load(place.read_bytes())
        made = make()
        with contextlib.suppress(OSError):
            write_whole(place, dump(made), durable=False)
            for old in sorted(place.parent.glob(f"*.{ending}"), key=lambda one: one.stat().st_mtime)[:-most]:
                old.unlink()
    return made
