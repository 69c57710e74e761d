"""Compiling hot loops, cached on disk where that is possible."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compiles with numba, once a machine rather than once a process.

    numba notices a change only in the file a function stands in. Hence the rule of this package: a compiled
    function calls compiled functions of its own file only.
    """
    try:
        return numba.njit(cache=True, nogil=True)(function)  # type: ignore[no-any-return]
    except RuntimeError:  # no folder to write the cache to: read-only installation without a home
        return numba.njit(nogil=True)(function)  # type: ignore[no-any-return]


def vectorised(function: F) -> F:
    """As `compiled`, for loops over pixels: a division by zero gives inf or nan, as NumPy's does.

    Python's own rule, an error, would put a branch into every division, and the loop would go pixel by pixel.
    """
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]
    except RuntimeError:
        return numba.njit(nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]
