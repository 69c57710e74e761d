"""Colour matrix and tone curves that map rendered tissue to the colours of a photograph."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import least_squares

from synth.arrays import Floats, Map
from synth.render.camera.camera_sensor import processed
from synth.render.camera.colour_processing import PLAIN, ColourProcessing

_PIXELS, _DIRECTIONS, _QUANTILES = 6000, 48, 100
_OFF_DIAGONAL = -0.6, 0.2  # range in published cameras
_KNOWN, _NEUTRAL = 0.1, 0.3  # weights of the priors for plain colours, and for equal curves of the channels


def fit_colours(light: Map, video: Floats) -> tuple[ColourProcessing, float]:
    """The matrix, rows of sum 1, and rising curves with the least sliced Wasserstein distance, and the cost.

    Pixels are projected on random directions, sorted, and subtracted (J. Rabin et al., 2011). Directions in
    which the photograph varies little have more weight, as lightness would dominate hue.

    Args:
        light: (N, 3) of rendered tissue, white-balanced, 1 at full scale.
        video: (M, 3) levels of the photograph's tissue, 0 to 1.
    """
    rng, plain = np.random.default_rng(0), np.array(PLAIN.curves)
    ours, theirs = rng.choice(light, _PIXELS)[None], rng.choice(video, _PIXELS)
    variances, axes = np.linalg.eigh(np.cov(theirs.T))
    directions = rng.standard_normal((3, _DIRECTIONS))
    directions /= np.linalg.norm(directions, axis=0)
    project = axes * (variances.max() / variances) ** 0.25 @ directions / np.sqrt(variances.sum())

    def quantiles(pixels: Floats) -> Floats:
        return np.asarray(np.sort(pixels @ project, axis=0).reshape(_QUANTILES, -1, _DIRECTIONS).mean(axis=1))

    wanted = quantiles(theirs)

    def residuals(free: Floats) -> Floats:
        colours = _colours(free)
        left = (quantiles(np.clip(processed(ours, *colours), 0, 1)[0]) - wanted) / np.sqrt(wanted.size)
        curves = np.array(colours.curves)
        unlike, odd = curves - curves.mean(axis=0), np.append(curves - plain, free[:6] - 1)
        return np.concatenate([left.ravel(), _NEUTRAL * unlike.ravel(), _KNOWN * odd])

    steps = np.log(np.diff(plain, axis=1, prepend=0))
    start = np.append(np.ones(6), steps[:, :4] - steps[:, 4:])
    ends = [np.repeat([1 + end, 8 * np.sign(end)], (6, 12)) for end in _OFF_DIAGONAL]
    found = least_squares(residuals, start, bounds=ends, max_nfev=40, diff_step=3e-3)
    return _colours(found.x), float(found.cost)


def _colours(free: Floats) -> ColourProcessing:
    """Colours from 6 off-diagonal elements plus 1, and 12 log steps of curves relative to the last."""
    matrix, off = np.eye(3), ~np.eye(3, dtype=bool)
    matrix[off] = free[:6] - 1
    matrix[~off] = 2 - matrix.sum(axis=1)
    steps = np.exp(np.pad(free[6:].reshape(3, 4), ((0, 0), (0, 1))))
    curves = np.cumsum(steps / steps.sum(axis=1, keepdims=True), axis=1)
    rows: list[Any] = [tuple(map(tuple, table.tolist())) for table in (matrix, curves)]
    return ColourProcessing(*rows)
