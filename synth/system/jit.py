"""Compiling hot loops, cached on disk where that is possible."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compiles with numba, once a machine rather than once a process.

    The cache lies in `NUMBA_CACHE_DIR`, else beside the package, else in the user's cache folder (numba's own
    order), else in a temporary one; where none can be written it is done without.

    numba notices a change only in the file a function stands in. Hence the rule of this package: a compiled
    function calls compiled functions of its own file only.
    """
    try:
        return _compile(function, cache=True)
    except RuntimeError:  # no folder to write to: read-only installation without a home
        folder = _temporary_folder()
    if folder is None:
        return _compile(function, cache=False)
    told, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
    try:
        return _compile(function, cache=True)
    except RuntimeError:  # a disk that is full
        return _compile(function, cache=False)
    finally:
        numba.config.CACHE_DIR = told


def _compile(function: F, *, cache: bool) -> F:
    return numba.njit(cache=cache, nogil=True)(function)  # type: ignore[no-any-return]


def _temporary_folder() -> Path | None:
    """This user's own folder among the temporary ones; None if it cannot be had.

    What is cached is code that will be run: a folder that others made or may write to is not used.
    """
    try:
        folder = Path(tempfile.gettempdir()) / f"sulcus-numba-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
    except OSError:
        return None
    own = stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid()
    return folder if own and not about.st_mode & 0o077 else None
