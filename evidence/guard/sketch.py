"""Sketches of arrays: a few numbers that tell whether, and by how much, an array has changed.

A sketch holds an array's norm, its largest absolute value, and its projections p_k = Σ_i s_ki x_i on eight
fixed vectors of signs s_ki = ±1. For a change Δ of the array each projection changes by a number of mean 0
and variance |Δ|², so that their root mean square estimates |Δ| from ten numbers. A changed sign, swapped
axes, a mirrored or a shifted picture change the projections, which means of absolute values would miss.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Sketch = dict[str, Any]
"""`shape`: of the array; `norm`, `largest`: numbers; `projections`: eight numbers."""

PROJECTIONS = 8
_DIGITS = 7  # that are stored: tolerances are 1e-4 and more


def sketch(name: str, array: Any) -> Sketch:
    """The sketch of an array of numbers or flags, of any shape. ValueError if a value is not finite.

    `name`: seed of the signs, so that different arrays are projected on different vectors.
    """
    values = np.asarray(array, np.float64)
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: has values that are not finite")
    flat = values.ravel()
    numbers = [float(np.linalg.norm(flat)), float(np.abs(flat).max(initial=0.0))]
    numbers += [float(np.dot(signs, flat)) for signs in _signs(name, flat.size)]
    norm, largest, *projections = (float(f"{number:.{_DIGITS}g}") for number in numbers)
    return {"shape": list(values.shape), "norm": norm, "largest": largest, "projections": projections}


def compare(before: Sketch, now: Sketch) -> float:
    """Relative change of an array between two sketches of it: an estimate of |Δ| over its norm.

    The larger of the estimate by projections and of the change of the norm; infinite for another shape. For
    an array of zeros that no longer is one, infinite too.
    """
    if list(before["shape"]) != list(now["shape"]):
        return math.inf
    pairs = zip(before["projections"], now["projections"], strict=True)
    change = math.sqrt(sum((new - old) ** 2 for old, new in pairs) / PROJECTIONS)
    change = max(change, abs(now["norm"] - before["norm"]))
    if change == 0:
        return 0.0
    return change / before["norm"] if before["norm"] else math.inf


def compare_all(before: Mapping[str, Sketch], now: Mapping[str, Sketch]) -> dict[str, float]:
    """Relative change by array of a probe; infinite for one that is gone. New arrays move nothing."""
    return {name: compare(old, now[name]) if name in now else math.inf for name, old in before.items()}


def sketch_all(arrays: Mapping[str, Any]) -> dict[str, Sketch]:
    """Sketches of named arrays."""
    return {name: sketch(name, array) for name, array in arrays.items()}


def _signs(name: str, size: int) -> Sequence[np.ndarray[Any, np.dtype[np.float64]]]:
    """Eight vectors (size,) of ±1 from a hash of the name: the same with every version of every library."""
    digest = hashlib.shake_256(name.encode()).digest((PROJECTIONS * size + 7) // 8)
    bits = np.unpackbits(np.frombuffer(digest, np.uint8), count=PROJECTIONS * size)
    return list(1.0 - 2.0 * bits.reshape(PROJECTIONS, size))
