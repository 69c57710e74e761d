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
    """Compiles with numba and its options `how`, cached where numba does, else in `synth.system.cache`.

    `NUMBA_CACHE_DIR` is used only if it is this user's alone. numba detects changes only in the function's
    file: hence the rule of this package that a compiled function only calls compiled ones of its own file.
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
    """As `compiled`, for loops over pixels: x / 0 is inf or nan; Python's exception would prevent vectors."""
    return compiled(function, error_model="numpy")
