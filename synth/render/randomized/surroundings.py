"""Randomisation of one sequence, and its surroundings: a sheet with a hole in place of a craniotomy's rim.

Shapes were chosen by eye.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from synth.arrays import Floats
from synth.geometry.triangles import grid_faces
from synth.render.anatomy import noise
from synth.render.appearance.family import Colour
from synth.render.materials import Body, Wet
from synth.render.randomized.pattern import Pattern, paint

_AROUND, _OUT = 128, 28
_TEXELS, _DRY = 768, 0.4


@dataclass(frozen=True)
class Surroundings:
    """A sheet around the tissue as drawn; lengths are shares of the opening's radius."""

    kind: str  # what it resembles, or nothing
    pattern: Pattern  # of sizes in radii, not mm
    corners: float  # exponent of the hole's superellipse: 2 round, more square
    longer: float  # the hole's length by its width
    lip: float  # height of its edge over the tissue
    rise: float  # outwards, a slope
    folds: float  # height of its folds
    index: float  # refractive index of its coat


@dataclass(frozen=True)
class Randomization:
    """What neither a job's keys nor an appearance express; of a group that is off as here."""

    scale: float = 1.0  # of the tissue: mm in a mm of the patch as it is grown and painted
    pattern: Pattern | None = None  # on the tissue; None: a painted cortex, or the job's photograph
    tint: Colour = (1.0, 1.0, 1.0)  # linear RGB of a cortex or photograph
    tinted: float = 0.0  # share of its colour that the tint replaces
    surroundings: Surroundings | None = None  # None: the rim of a craniotomy


def sheet(
    surroundings: Surroundings, tissue: Floats, radius_mm: float, width_mm: float, ambient: Floats
) -> Body:
    """The sheet around an opening of a radius, as wide as `width_mm`.

    `tissue`: (V, 3) mm, a square patch around the opening, whose edge it hides; `ambient`: as of `Wet`.
    """
    angle, power = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False), surroundings.corners
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    hole = (np.abs(directions / [surroundings.longer, 1.0]) ** power).sum(axis=1, keepdims=True) ** (
        -1 / power
    )
    hole = radius_mm * np.minimum(0.92 * hole / hole.min(), 1.2)
    distance = np.concatenate([[0.0, 0.0], width_mm * np.linspace(0, 1, _OUT) ** 2])
    xy = ((hole + distance)[..., None] * directions[:, None]).reshape(-1, 2)
    # Over the paraboloid through the tissue's heights, and not steeper down than it beyond the patch.
    r2, z = (tissue[:, :2] ** 2).sum(axis=1), tissue[:, 2]
    outer = r2 > (0.8 * radius_mm) ** 2
    (bend, top), *_ = np.linalg.lstsq(np.stack([r2, np.ones_like(r2)], 1)[outer], z[outer], rcond=None)
    edge = bend * hole**2 + top + float((z - bend * r2 - top)[outer].max())
    extent = 2.1 * float((hole + distance).max())
    wave = noise.band(np.random.default_rng(surroundings.pattern.seed + 1), 128, extent, 0.8 * radius_mm, 0.6)
    folds = np.maximum(noise.sample(wave, xy, extent).reshape(_AROUND, -1) + 1, 0)
    height = (
        edge
        + surroundings.lip * radius_mm
        + max(surroundings.rise, 2 * min(bend, 0.0) * radius_mm) * distance
    )
    height = height + surroundings.folds * radius_mm * folds * np.minimum(distance / radius_mm, 1)
    height[:, :1] = edge - 0.5 * radius_mm  # the hole's wall ends in the tissue
    pattern = replace(surroundings.pattern, size_mm=radius_mm * surroundings.pattern.size_mm)
    coat = Wet(lambda: paint(pattern, _TEXELS, extent), pattern.roughness, _DRY, ambient, surroundings.index)
    faces = grid_faces(_AROUND, len(distance), "rows").reshape(-1, 3)
    return Body(np.column_stack([xy, height.ravel()]), faces, (xy / extent + 0.5).astype(np.float32), coat)
