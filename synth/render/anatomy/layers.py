"""Painting of maps in layers: soft borders, ridges, speckled colours, absorbing layers, opaque layers."""

from __future__ import annotations

import numpy as np

from synth.arrays import Array, Map

Rgb = tuple[float, float, float]


def step(x: Array) -> Map:
    """A smooth step of `x` (...), from 0 at -0.5 to 1 at 0.5."""
    t = np.clip(x + 0.5, 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float32)


def ridge(x: Array, width: float, centre: float = 0.0) -> Array:
    """A Gaussian ridge of `x` (...): 1 at `centre`, 1/e at a distance of `width`."""
    return np.asarray(np.exp(-(((x - centre) / width) ** 2)))


def speckle(colour: Rgb, *contrasts: Array) -> Array:
    """A colour (r, n, 3), linear RGB, that varies by the sum of `contrasts` (r, n), as shares of it."""
    return np.asarray(np.asarray(colour, np.float32) * np.asarray(sum(contrasts, 1))[..., None])


def attenuate(colour: Array, depth: Array, absorption: Rgb) -> Array:
    """Colours (r, n, 3) under a layer (Beer-Lambert) of optical depth `depth` (r, n) times `absorption`."""
    if not depth.any():  # of most rows, by most layers
        return colour
    return np.asarray(colour * np.exp(-depth[..., None] * np.array(absorption, np.float32)))


def over(below: Array, above: Array, share: Array) -> Array:
    """One layer (r, n, 3) or map (r, n) over another, of which it covers a share that broadcasts."""
    if below.ndim == share.ndim and not share.any():
        return below
    return np.asarray(below * (1 - share) + above * share)
