"""The check of a public function's arguments against its annotations."""

from __future__ import annotations

import functools
import inspect
import math
import re
import typing
from collections.abc import Callable, Iterable, Sequence
from numbers import Integral, Real
from pathlib import Path
from types import UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union

import numpy as np

from synth.errors import UserError

P = ParamSpec("P")
R = TypeVar("R")
_ARRAYS = r"\b(Map|Mask|Floats|Pixels|Array)\b"


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function; arguments that are not what its annotations state end in a UserError that names them.

    Booleans are no numbers, which must be finite; a protocol needs its methods; lists of numbers become
    arrays.
    """
    signature, title = inspect.signature(function), re.sub(r"\.__\w+__$", "", function.__qualname__)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        bound = signature.bind(*args, **kwargs)
        for name, value in list(bound.arguments.items()):
            hint = _hints(function).get(name, Any)  # `self` has none; further keywords any
            if not _fits(value, hint):
                expected = re.sub(_ARRAYS, "array", str(function.__annotations__[name]))
                shown_value = (
                    repr(value)[:80] if isinstance(value, (str, Real, Path, list, tuple)) else type(value)
                )
                raise UserError(f"{title}: {name}: expected {expected}, got {shown_value}")
            if isinstance(value, (list, tuple)) and np.ndarray in map(_kind, (hint, *typing.get_args(hint))):
                bound.arguments[name] = np.asarray(value)
        return function(*bound.args, **bound.kwargs)

    return call


_hints = functools.cache(typing.get_type_hints)


def _kind(hint: Any) -> Any:
    kind = typing.get_origin(hint) or hint
    # Since NumPy 2.5 `NDArray` is a named alias of the array's type.
    return _kind(kind.__value__) if hasattr(kind, "__value__") else kind


def _fits(value: Any, hint: Any) -> bool:
    kind, args = _kind(hint), typing.get_args(hint)
    if kind is Any:
        return True
    if kind in (Union, UnionType):
        is_blank = Path in args and isinstance(value, str) and not value
        return not is_blank and any(_fits(value, member) for member in args)
    if kind is Literal:
        return isinstance(value, str) and value in args
    if kind in (int, float):
        number = isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
        return number and math.isfinite(value)
    if kind is np.ndarray:
        try:
            return np.ndim(value) > 0 and np.asarray(value).dtype.kind in "biuf"
        except (ValueError, TypeError):  # ragged lists
            return False
    if getattr(kind, "_is_protocol", False) and kind is not Iterable:
        members = [name for name, attribute in vars(kind).items() if callable(attribute) and name[0] != "_"]
        return all(callable(getattr(value, name, None)) for name in members or ["__call__"])
    if kind in (Sequence, Iterable) and isinstance(value, (str, bytes)):
        return False
    if kind is Sequence and isinstance(value, Sequence):
        return all(_fits(item, args[0]) for item in value)
    return isinstance(value, kind)
