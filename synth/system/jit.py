"""Compilation of hot loops by numba, cached on disk where possible.

What a loop costs to compile is mostly numba's own typing of it: 0.2 to 1.5 s. Slices that are assigned
(`a[:] = b`) cost 0.6 to 2 s more, since the message for wrong shapes is compiled with them: write a loop.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.sigutils import normalize_signature

from synth.arrays import Array
from synth.system import cache, target_processor

F = TypeVar("F", bound=Callable[..., Any])

LOOPS: list[tuple[Any, str]] = []
"""Loops and the types of their arguments, of the modules that are imported, see `argument_types`."""


def compiled(function: F, **options: str) -> F:
    """Compiles with numba and its `options`, cached where numba does, else in `synth.system.cache`.

    `NUMBA_CACHE_DIR` is used only if it is this user's alone. numba detects changes only in the function's
    file: hence the rule of this package that a compiled function only calls compiled ones of its own file.
    """
    before = numba.config.CACHE_DIR
    with suppress(RuntimeError):  # no writable folder: a read-only installation without a home
        if not before or cache.is_private(Path(before)):
            return numba.njit(cache=True, nogil=True, **options)(function)  # type: ignore[no-any-return]
    try:
        numba.config.CACHE_DIR = str(cache.folder("loops"))
        return numba.njit(cache=True, nogil=True, **options)(function)  # type: ignore[no-any-return]
    except (RuntimeError, OSError):  # no temporary folder either, or a full disk
        return numba.njit(nogil=True, **options)(function)  # type: ignore[no-any-return]
    finally:
        numba.config.CACHE_DIR = before


def vectorised(function: F) -> F:
    """As `compiled`, for loops over pixels: x / 0 is inf or nan; Python's exception would prevent vectors."""
    return compiled(function, error_model="numpy")


def inlined(function: F) -> F:
    """A part of the compiled functions in its file: written into them, so that it isn't compiled itself."""
    return numba.njit(inline="always")(function)  # type: ignore[no-any-return]


def argument_types(types: str) -> Callable[[F], F]:
    """Decorates a compiled function that every dataset needs: `compile_loops` compiles it for these types."""

    def register(function: F) -> F:
        LOOPS.append((function, types))
        return function

    return register


def as_constant(array: Array) -> Array:
    """A view that can't be written to. A loop is compiled for both kinds of arrays unless it gets one."""
    view = array.view()
    view.flags.writeable = False
    return view


def compile_loops(part: int, parts: int) -> None:
    """Compiles one of `parts` of equal work of `LOOPS`, or loads them if they are in the cache."""
    largest_first = sorted(LOOPS, key=lambda loop: -len(loop[0].py_func.__code__.co_code))
    for function, types in largest_first[part::parts]:
        # As a tuple of types: numba's cache takes what it is given as the key.
        function.compile(normalize_signature(f"({types})")[0])


def _choose_target() -> None:
    if numba.config.CPU_NAME is None and target_processor.has_common():
        numba.config.CPU_NAME, numba.config.CPU_FEATURES = target_processor.COMMON, ""


_choose_target()
