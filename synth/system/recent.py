"""Results of the last few calls, kept in memory and found again by their inputs' content."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import scipy.sparse as sp

Result = TypeVar("Result")


class Recent(Generic[Result]):
    """The last results of one computation. Whoever gets one must not write to it.

    Args:
        most: how many are kept.
        size: a result's bytes.
        largest: bytes above which a result is not kept.
    """

    def __init__(self, most: int, size: Callable[[Result], int], largest: int = 1 << 26) -> None:
        self._most, self._size, self._largest = most, size, largest
        self._kept: OrderedDict[bytes, Result] = OrderedDict()

    def get(self, make: Callable[[], Result], *inputs: Any) -> Result:
        """The result of `make`, which depends on nothing but the inputs.

        These are arrays, sparse arrays, values whose `repr` is their content, and tuples, lists and
        dataclasses of these.
        """
        key = _digest(inputs)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        result = make()
        if self._size(result) <= self._largest:
            self._kept[key] = result
            if len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return result


def _digest(inputs: tuple[Any, ...]) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for part in _parts(inputs):
        digest.update(part)
    return digest.digest()


def _parts(value: Any) -> Iterator[bytes | memoryview]:
    """The content of a value, piece by piece, each after its kind and size."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).data.cast("B") if value.size else b""
    elif sp.issparse(value):
        rows = value.tocsr()
        yield from _parts((rows.data, rows.indices, rows.indptr))
    elif isinstance(value, tuple | list):
        yield f"{len(value)} of".encode()
        for item in value:
            yield from _parts(item)
    elif is_dataclass(value):
        yield from _parts(tuple(getattr(value, field.name) for field in fields(value)))
    else:
        text = repr(value).encode()
        yield f"{len(text)} ".encode()
        yield text
