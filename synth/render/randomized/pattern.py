"""Patterns on randomised tissue and surroundings, in place of a painted cortex and rim.

Sizes and contrasts were chosen by eye, to be wider than reality.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from synth.arrays import Map
from synth.render.anatomy import noise
from synth.render.anatomy.layers import over, step
from synth.render.anatomy.texture import normals
from synth.render.appearance.family import Colour
from synth.render.materials import Coat

_DRY_PX = 64
_GRAIN = 0.03  # contrast of the finest mottling of every pattern


@dataclass(frozen=True)
class Pattern:
    """One pattern as drawn."""

    kind: str  # spectrum, speckle, silicone, weave, streaks, lines, dots, cells, fat or liver
    colours: tuple[Colour, Colour, Colour]  # linear RGB at its lowest, middle and highest level
    size_mm: float  # of its cells, dots, threads or longest waves
    slope: float  # 0 to 3: of a spectrum, amplitude ~ 1/f^slope; of dots, their disorder
    relief: float  # height, as a share of its size
    dry: float  # share of the surface under a film too thin to be smooth
    roughness: float  # GGX alpha of the coat under film
    seed: int


def paint(pattern: Pattern, pixels: int, extent_mm: float) -> Coat:
    """Maps of a pattern over a square of side `extent_mm`, `pixels` on a side."""
    rng = np.random.default_rng(pattern.seed)
    level = np.clip(_levels(pattern, rng, pixels, extent_mm), 0, 1).astype(np.float32)
    low, middle, high = (np.asarray(colour, np.float32) for colour in pattern.colours)
    doubled = 2 * level[..., None]
    albedo = over(over(low, middle, np.minimum(doubled, 1)), high, np.maximum(doubled - 1, 0))
    albedo *= 1 + _GRAIN * noise.fractal(rng, pixels, extent_mm, 0.05 * extent_mm, 1.0)[..., None]
    height = np.float32(pattern.relief * pattern.size_mm) * level
    normal_map = normals(noise.blur(height, 1.5 * extent_mm / pixels, extent_mm), extent_mm)
    dry = pattern.dry + 0.2 * noise.fractal(rng, _DRY_PX, extent_mm, 0.2 * extent_mm, 1.5)
    return Coat(
        np.clip(albedo, 0.01, 0.95).astype(np.float32), normal_map, np.clip(dry, 0, 1).astype(np.float32)
    )


def apply_tint(albedo: Map, tint: Colour, share: float) -> Map:
    """An albedo (n, n, 3) with a share of its colour replaced by a tint of the same relative brightness."""
    brightness = albedo.mean(axis=2, keepdims=True) / albedo.mean()
    return np.asarray(np.clip((1 - share) * albedo + share * brightness * tint, 0.01, 0.95), np.float32)


def _levels(pattern: Pattern, rng: np.random.Generator, pixels: int, extent_mm: float) -> Map:
    """Levels (n, n), about 0 to 1, of a kind of pattern."""
    kind, size, ground = pattern.kind, pattern.size_mm, (pixels, extent_mm)
    place, cell_px = noise.centres(*ground) / size, pixels * size / extent_mm  # in elements; pixels in each
    if kind == "spectrum":
        return np.asarray(0.5 + 0.28 * noise.fractal(rng, *ground, size, pattern.slope))
    if kind == "speckle":  # blots about half a wavelength wide, as sprayed for digital image correlation
        return step(4 * noise.band(rng, *ground, 2 * size, 0.3))
    if kind == "silicone":  # even, with few bubbles
        bubbles = 0.5 * (noise.band(rng, *ground, 0.3 * size, 0.3) > 3.2)
        waves = 0.5 + 0.05 * noise.fractal(rng, *ground, 4 * size, 2.5)
        return noise.blur((waves + bubbles).astype(np.float32), 0.3, extent_mm)
    if kind == "weave":
        wave, wear = np.sin(2 * np.pi * place), noise.fractal(rng, *ground, 0.3 * extent_mm, 2.0)
        return np.asarray(0.5 + 0.3 * wave * wave[:, None] + 0.1 * wear)
    if kind == "streaks":  # of brushed metal, of wood
        fine = noise.fractal(rng, *ground, size, pattern.slope)[:, : max(pixels // 16, 8)]
        return np.asarray(0.5 + 0.22 * cv2.resize(fine, (pixels, pixels), interpolation=cv2.INTER_CUBIC))
    if kind == "lines":  # of paper, in half of them squares
        line = step((0.06 - np.abs(place - np.rint(place))) * cell_px)
        return np.asarray(1 - np.maximum(line[:, None], line * bool(rng.integers(2))))
    if kind == "dots":
        cell = np.floor(place - place[0]).astype(int)
        count = int(cell[-1]) + 1
        inside = place - place[0] - cell - 0.5
        offsets = 0.08 * pattern.slope * rng.uniform(-1, 1, (2, count, count))
        x, y = np.meshgrid(cell, cell)
        distance = np.hypot(inside - offsets[0][y, x], inside[:, None] - offsets[1][y, x])
        return np.asarray(step((0.27 - distance) * cell_px) * rng.uniform(0.4, 1, (count, count))[y, x])
    seeds = rng.integers(pixels, size=(2, max(int((extent_mm / size) ** 2), 4)))
    background = np.ones(ground[:1] * 2, np.uint8)
    background[seeds[0], seeds[1]] = 0
    distance, labels = cv2.distanceTransformWithLabels(
        background, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    distance = distance / np.float32(cell_px)
    if kind == "cells":  # Voronoi's, dark at their borders
        borders = cv2.morphologyEx(labels.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0
        levels = np.where(borders, 0, rng.uniform(0.15, 1, int(labels.max()) + 1)[labels])
        return noise.blur(levels.astype(np.float32), 0.7 * extent_mm / pixels, extent_mm)
    if kind == "fat":  # round lobules
        lumps = noise.fractal(rng, *ground, size, 2.0)
        return np.asarray(np.sqrt(np.clip(1 - (1.3 * distance) ** 2, 0, 1)) * (0.85 + 0.1 * lumps))
    waves = noise.fractal(rng, *ground, 12 * size, 2.0)  # liver: faint lobules
    return np.asarray(0.5 + 0.12 * waves - 0.25 * np.clip(distance, 0, 1))
