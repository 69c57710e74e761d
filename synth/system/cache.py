"""Where compiled code is kept between runs: a folder of our own, bounded, that can always be written."""

from __future__ import annotations

import functools
import os
import tempfile
from pathlib import Path

LIMIT_BYTES = 512 * 1024**2
"""What the renderer's compiled kernels may take; the least recently used go first."""


@functools.cache
def folder(name: str) -> Path:
    """A folder for one kind of compiled code, made if it isn't there.

    `SULCUS_CACHE` is asked first, then the user's cache (`XDG_CACHE_HOME`, else ~/.cache); where neither can
    be written (no home, read-only), a folder of this user's in the system's temporary one.
    """
    tried = []
    if "SULCUS_CACHE" in os.environ:
        tried.append(Path(os.environ["SULCUS_CACHE"]))
    if "XDG_CACHE_HOME" in os.environ:
        tried.append(Path(os.environ["XDG_CACHE_HOME"]) / "sulcus")
    home = os.environ.get("HOME")
    if home:
        tried.append(Path(home) / ".cache" / "sulcus")
    for place in tried:
        try:
            (place / name).mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(place / name, os.W_OK):
            return place / name
    # Of this user alone: what is loaded from here runs.
    mine = Path(tempfile.gettempdir()) / f"sulcus-{os.getuid()}"
    mine.mkdir(mode=0o700, exist_ok=True)
    if mine.is_symlink() or mine.stat().st_uid != os.getuid():
        mine = Path(tempfile.mkdtemp(prefix="sulcus-"))
    (mine / name).mkdir(exist_ok=True)
    return mine / name


def size_bytes(place: Path) -> int:
    """What the files in a folder take on disk."""
    return sum(file.stat().st_size for file in place.rglob("*") if file.is_file())
