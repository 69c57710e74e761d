"""Compiling hot loops, cached on disk where that is possible."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

from synth.system import cache

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compiles with numba, once a machine rather than once a process.

    The cache lies in `NUMBA_CACHE_DIR`, else beside the package, else in the user's cache folder (numba's own
    order), else in ours (`synth.system.cache`); where none can be written it is done without.

    numba notices a change only in the file a function stands in. Hence the rule of this package: a compiled
    function calls compiled functions of its own file only.
    """
    return _compile(function)


def vectorised(function: F) -> F:
    """As `compiled`, for loops over pixels: a division by zero gives inf or nan, as NumPy's does.

    Python's own rule, an error, would put a branch into every division, and the loop would go pixel by pixel.
    """
    return _compile(function, error_model="numpy")


def _compile(function: F, **how: str) -> F:
    try:
        return numba.njit(cache=True, nogil=True, **how)(function)  # type: ignore[no-any-return]
    except RuntimeError:  # no folder to write to: read-only installation without a home
        before = numba.config.CACHE_DIR
    try:
        numba.config.CACHE_DIR = str(cache.folder("loops"))
        return numba.njit(cache=True, nogil=True, **how)(function)  # type: ignore[no-any-return]
    except (RuntimeError, OSError):  # nor a temporary one, or a disk that is full
        return numba.njit(nogil=True, **how)(function)  # type: ignore[no-any-return]
    finally:
        numba.config.CACHE_DIR = before
