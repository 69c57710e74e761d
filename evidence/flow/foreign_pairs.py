"""Pairs of known motion as neighbouring fields have them: speckle, layers, a street's pan."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from evidence.flow.measure import epe
from evidence.flow.scenes import Flags, Floats, Rgb, noise_field
from synth.flow.estimator import create
from synth.flow.track import Tracker

_FINE, _MARGIN, _SIZE, _INNER = 2, 40, 160, 12
_SHIFTS_PX = (0.1, 0.35, 0.5, 1.25, 3.4, 7.8)
_STRETCH = 0.004  # per px of shift: what DIC calls strain
_Grid = NDArray[np.float64]


def rows(count: int, seed: int) -> list[dict[str, Any]]:
    """Each figure asked against measured, `count` pairs a figure."""
    names = ("tvl1", "opencv-tvl1", "dis")
    speckle: dict[str, list[float]] = {n: [] for n in names}
    edges: dict[str, list[float]] = {n: [] for n in names}
    street: dict[str, list[float]] = {"tvl1": [], "dis": []}
    flagged = 0
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        pooled: dict[str, list[Floats]] = {n: [] for n in names}
        for shift in _SHIFTS_PX:
            rest, now, flow, seen = speckled(shift, rng)
            for name, errors in pooled.items():
                errors.append(_error(name, rest, now, flow)[seen])
        for name, errors in pooled.items():
            speckle[name].append(float(np.median(np.concatenate(errors))))
        rest, now, flow, seen = layered(rng)
        for name, found in edges.items():
            found.append(float(np.percentile(_error(name, rest, now, flow)[seen], 95)))
        rest, now, flow, seen = panned(rng)
        every = np.ones(seen.shape, bool)
        tracker = Tracker("tvl1", rest, ~every, every)
        street["tvl1"].append(float(epe(tracker.step(now, ~every)[0], flow)[seen].mean()))
        street["dis"].append(float(_error("dis", rest, now, flow)[seen].mean()))
        flagged += not tracker.trusted
    return [
        _row("speckle, 0.1 to 7.8 px, median error [px]", "≤ 0.02", speckle),
        _row("layers of other motion, 95th percentile [px]", "≤ opencv-tvl1", edges),
        _row("50 px at 1242 px, mean error [px]", "< dis, or flagged", street) | {"flagged": flagged},
    ]


def _row(what: str, asked: str, found: dict[str, list[float]]) -> dict[str, Any]:
    return {"what": what, "asked": asked} | {n: round(float(np.mean(v)), 4) for n, v in found.items()}


def _error(name: str, rest: Rgb, now: Rgb, flow: Floats) -> Floats:
    every = np.ones(flow.shape[:2], bool)
    return epe(create(name).flow(rest, now, every, every)[0], flow)


def _grains(rng: np.random.Generator, width: float) -> Floats:
    """Cubic-spline coefficients of a speckle pattern [grey levels]."""
    side = _FINE * (_SIZE + 2 * _MARGIN)
    field = gaussian_filter(rng.standard_normal((side, side)), width * _FINE / 4)
    grains = gaussian_filter((field > 0.1 * field.std()).astype(np.float32), 0.5 * _FINE)
    return np.asarray(spline_filter(30 + 190 * grains, 3), np.float32)


def _read(pattern: Floats, x: _Grid, y: _Grid) -> _Grid:
    at = [(q + _MARGIN + 0.5) * _FINE - 0.5 for q in (y, x)]
    return np.asarray(map_coordinates(pattern, at, order=3, mode="mirror", prefilter=False), np.float64)


def _seen(grey: _Grid, rng: np.random.Generator) -> Rgb:
    noisy = np.clip(np.round(grey + rng.normal(0, 1.0, grey.shape)), 0, 255).astype(np.uint8)
    return np.repeat(noisy[..., None], 3, -1)


Made = tuple[Rgb, Rgb, Floats, Flags]
"""Rest frame, now frame, flow (H, W, 2) px, and (H, W) where it is judged."""


def _grid() -> Iterator[_Grid]:
    y, x = np.mgrid[:_SIZE, :_SIZE].astype(float)
    yield from (x, y)


def _inner() -> Flags:
    inner = np.zeros((_SIZE, _SIZE), bool)
    inner[_INNER:-_INNER, _INNER:-_INNER] = True
    return inner


def speckled(shift_px: float, rng: np.random.Generator) -> Made:
    """A shift with a little stretch, w = s + e (x - c), whose inverse is in closed form too."""
    x, y = _grid()
    pattern, turn, centre = _grains(rng, 3.2), rng.uniform(0, 2 * np.pi), _SIZE / 2
    stretch = _STRETCH * shift_px
    sx, sy = shift_px * np.cos(turn), shift_px * np.sin(turn)
    flow = np.stack([sx + stretch * (x - centre), sy + stretch * (y - centre)], -1)
    source = [(q - s + stretch * centre) / (1 + stretch) for q, s in ((x, sx), (y, sy))]
    rest, now = _seen(_read(pattern, x, y), rng), _seen(_read(pattern, source[0], source[1]), rng)
    return rest, now, flow.astype(np.float32), _inner()


def layered(rng: np.random.Generator) -> Made:
    """A star that moves over a ground that moves otherwise; judged where both frames show the point."""
    x, y = _grid()
    ground, star = _grains(rng, 6.0), _grains(rng, 5.0)
    own, other = rng.uniform(-4, 4, 2), rng.uniform(-4, 4, 2)

    def inside(px: _Grid, py: _Grid) -> Flags:
        dx, dy = px - _SIZE / 2, py - _SIZE / 2
        edge = 0.28 * _SIZE * (1 + 0.25 * np.sin(5 * np.arctan2(dy, dx)))
        return np.asarray(np.hypot(dx, dy) < edge, bool)

    def shot(a: NDArray[np.float64], b: NDArray[np.float64]) -> Rgb:
        cover = gaussian_filter(inside(x - a[0], y - a[1]).astype(float), 0.5)
        below = 0.7 * _read(ground, x - b[0], y - b[1])
        return _seen(below + cover * (_read(star, x - a[0], y - a[1]) - below), rng)

    still = np.zeros(2)
    top = inside(x, y)
    hidden = ~top & inside(x + other[0] - own[0], y + other[1] - own[1])
    flow = np.where(top[..., None], own, other).astype(np.float32)
    return shot(still, still), shot(own, other), flow, _inner() & ~hidden


def panned(rng: np.random.Generator, width: int = 414) -> Made:
    """A street passed by, nearer below: 50 px at a width of 1242 px, at the width that flow works on."""
    height, largest, spare = round(0.3 * width), 50 * width / 1242, 60
    shape = (height, width + 2 * spare)
    scales = ((8.0, 1.0), (30.0, 1.5), (120.0, 2.0))
    wall = sum((a * noise_field(shape, max(2.0, s * width / 1242), rng) for s, a in scales), np.zeros(shape))
    pattern = spline_filter(110 + 14 * wall, 3)
    y, x = np.mgrid[:height, :width].astype(float)
    pan = largest * (0.3 + 0.7 * y / height)  # a row has one shift, so the inverse is exact
    rest, now = (
        _seen(map_coordinates(pattern, [y, at + spare], order=3, mode="mirror", prefilter=False), rng)
        for at in (x, x - pan)
    )
    flow = np.stack([pan, np.zeros_like(pan)], -1).astype(np.float32)
    return rest, now, flow, np.asarray(x + pan < width - 4, bool)
