"""Layers on maps: soft borders, ridges, speckled colours, what a layer lets through, one over another."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Rgb = tuple[float, float, float]


def step(x: Array) -> npt.NDArray[np.float32]:
    """A smooth step of `x` (...), from 0 at -0.5 to 1 at 0.5."""
    t = np.clip(x + 0.5, 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float32)


def ridge(x: Array, width: float, at: float = 0.0) -> Array:
    """A Gaussian ridge of `x` (...): 1 where that is `at`, 1/e a `width` from there."""
    return np.asarray(np.exp(-(((x - at) / width) ** 2)))


def speckled(colour: Rgb, *contrasts: Array) -> Array:
    """A colour, linear RGB, that varies by `contrasts` (r, n), each a share of it: (r, n, 3)."""
    return np.asarray(np.asarray(colour, np.float32) * np.asarray(sum(contrasts, 1))[..., None])


def through(colour: Array, depth: Array, absorption: Rgb) -> Array:
    """Colours (r, n, 3) under a layer of Beer and Lambert's `depth` (r, n), times `absorption` a channel."""
    return np.asarray(colour * np.exp(-depth[..., None] * np.array(absorption, np.float32)))


def over(below: Array, above: Array, share: Array) -> Array:
    """One layer over another (r, n, 3), or numbers (r, n), of which it covers a share that broadcasts."""
    return np.asarray(below * (1 - share) + above * share)
