"""Computed matrices in this user's cache."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np

from synth.arrays import Array
from synth.system import cache


def cached_matrix(name: str, key: bytes, make: Callable[[], Array], most: int) -> Array:
    """The result of `make`, from the cache `name` if it is there; arguments as of `cache.cached`."""
    # Files that were cut off by a full disk are computed again.
    return cache.cached(f"{name}/npy", key, make, _dump, _load, (ValueError, EOFError), most)


def _dump(matrix: Array) -> bytes:
    np.save(held := io.BytesIO(), matrix)
    return held.getvalue()


def _load(data: bytes) -> Array:
    return np.asarray(np.load(io.BytesIO(data), allow_pickle=False))
