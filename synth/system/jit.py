"""Compilation of hot loops by numba, cached on disk where possible."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numba

from synth.system import cache

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F, **how: str) -> F:
    """Compiles with numba and its options `how`, once per machine rather than once per process.

    The cache is in `NUMBA_CACHE_DIR` if it is this user's alone; without that next to the package, else in
    the user's cache folder (numba's own order); else in ours (`synth.system.cache`), if it is writable.

    numba detects changes only in the file of the function itself. Hence the rule of this package: a compiled
    function only calls compiled functions of its own file.
    """
    before = numba.config.CACHE_DIR
    with suppress(RuntimeError):  # no writable folder: a read-only installation without a home
        if not before or cache.is_private(Path(before)):
            return numba.njit(cache=True, nogil=True, **how)(function)  # type: ignore[no-any-return]
    try:
        numba.config.CACHE_DIR = str(cache.folder("loops"))
        return numba.njit(cache=True, nogil=True, **how)(function)  # type: ignore[no-any-return]
    except (RuntimeError, OSError):  # no temporary folder either, or a full disk
        return numba.njit(nogil=True, **how)(function)  # type: ignore[no-any-return]
    finally:
        numba.config.CACHE_DIR = before


def vectorised(function: F) -> F:
    """As `compiled`, for loops over pixels: a division by zero gives inf or nan, as in NumPy.

    Python's rule, an exception, would add a branch to every division and prevent vectorisation.
    """
    return compiled(function, error_model="numpy")
