"""Vessels of the pia: veins and arteries from trunks along the sulci down to the finest arterioles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.arrays import Floats, Ints, Map, Mask
from synth.render.anatomy import noise, trunk, tube
from synth.render.anatomy.tree import Tree, grow, murray, pruned, relaxed, scattered, taper

Trunks = tuple[tuple[Floats, Ints], Floats]

_STIFF_MM = 0.15  # radius of a vessel that winds half as far as the finest
_PATCH_MM = 34.0  # side of the patch that `Kind.trunks` are counted on


@dataclass(frozen=True)
class Kind:
    """Growth of one kind of vessel; lengths in mm, chosen by eye on an intra-operative photograph."""

    trunks: tuple[int, int]  # least number, and one more than the largest
    radius: tuple[float, float]  # of a trunk
    smooth: int  # rounds of smoothing over a trunk
    wiggle: float  # share of a trunk's short bends
    spacings: tuple[float, ...]  # of the branches of each round
    leaf: float  # radius of the finest: Murray's law gives the others'
    wander: float  # random part of a step's direction
    settle: float = 0.0  # shift of a trunk into its cleft, per round of smoothing
    winding: float = 0.0  # amplitude of bends


VEINS = Kind((1, 4), (0.55, 1.2), 60, 0.0, (9.0, 5.5), 0.1, 0.3, settle=0.1)
ARTERIES = Kind((4, 7), (0.2, 0.4), 40, 0.12, (5.2, 2.6, 1.3, 0.7, 0.46), 0.042, 0.25, winding=0.1)
DEEP = Kind((3, 4), (0.1, 0.2), 18, 0.2, (3.6, 1.9), 0.05, 0.35)  # coarser than the finest of the pia


@dataclass(frozen=True)
class Vessels:
    """All vessels of one anatomy."""

    veins: Tree
    arteries: Tree
    deep: Tree  # below the pia, visible through the tissue


def grow_all(sulci: Map, extent_mm: float, rng: np.random.Generator) -> Vessels:
    """Vessels that follow the sulci.

    Args:
        sulci: (n, n) depth below the gyri, 0 on a crown to 1 in a sulcus.
        extent_mm: side of the square that the map covers.
        rng: of the anatomy.
    """
    veins = _tree(VEINS, _trunks(VEINS, sulci, extent_mm, rng), extent_mm, rng)
    trunks = _trunks(ARTERIES, sulci, extent_mm, rng)
    # The density of arteries varies between gyri, and is 0 on a wide vein.
    rich = 0.9 + 0.35 * noise.band(rng, 128, extent_mm, 9.0, 0.5)
    distance, width = tube.raster(veins, 128, extent_mm)
    rich = np.clip(rich, 0.3, 1.0) * ((distance > width + 0.3) | (width < 0.3))
    arteries = _tree(ARTERIES, trunks, extent_mm, rng, np.asarray(rich, np.float32))
    deep = _tree(DEEP, _trunks(DEEP, sulci, extent_mm, rng), extent_mm, rng)
    return Vessels(veins, arteries, deep)


def _trunks(kind: Kind, sulci: Map, extent_mm: float, rng: np.random.Generator) -> Trunks:
    count = round(extent_mm / _PATCH_MM * rng.integers(*kind.trunks))
    bends = {"wiggle": kind.wiggle, "settle": kind.settle}
    return trunk.trunks(sulci, extent_mm, rng, count, kind.radius, smooth=kind.smooth, **bends)


def _tree(
    kind: Kind, trunks: Trunks, extent_mm: float, rng: np.random.Generator, density: Map | None = None
) -> Tree:
    """A tree from trunks and their radii: branches, then finer ones from those, a round per spacing."""
    (nodes, parent), own = trunks
    fixed = len(nodes)
    for spacing in kind.spacings:
        step = 0.15 * min(spacing, 1.6)
        grown = len(nodes)
        between = np.linalg.norm(nodes[1] - nodes[0])
        nodes, parent = grow(
            nodes,
            parent,
            scattered(extent_mm, spacing, rng, density),
            buds=_sprouting(len(nodes), float(between) / (0.9 * spacing), rng),
            step=step,
            kill=0.5 * spacing,
            wander=kind.wander,
            rng=rng,
        )
        nodes, parent = pruned(nodes, parent, grown, shortest=int(0.55 * spacing / step))
    nodes = relaxed(nodes, parent, fixed, rounds=12)
    nodes = nodes + trunk.meander(rng, nodes, extent_mm, 0.3, 0.22)
    radius = murray(parent, kind.leaf) * taper(nodes, parent, 1.6)
    radius[:fixed] = np.maximum(np.minimum(radius[:fixed], 1.3 * own), own)
    swell = 1 + 0.15 * noise.sample(noise.band(rng, 256, extent_mm, 2.0, 0.5), nodes[fixed:], extent_mm)
    radius[fixed:] = np.minimum(radius[fixed:] * np.clip(swell, 0.6, 1.4), 0.8 * own.max())
    if kind.winding:
        nodes = nodes + _wound(rng, nodes, radius, extent_mm, kind.winding)
    return Tree(nodes, parent, radius)


def _wound(
    rng: np.random.Generator, nodes: Floats, radius: Floats, extent_mm: float, amplitude: float
) -> Floats:
    """Shift (N, 2) mm that winds vessels in bends of one or two millimetres, wide ones less."""
    bends = [noise.sample(noise.band(rng, 256, extent_mm, 1.7, 0.35), nodes, extent_mm) for _ in range(2)]
    stiff = 1 / (1 + (radius / _STIFF_MM) ** 2)
    return np.asarray(amplitude * stiff[:, None] * np.stack(bends, axis=1), np.float64)


def _sprouting(count: int, share: float, rng: np.random.Generator) -> Mask:
    """A random share of nodes, at least one."""
    buds = rng.random(count) < share
    buds[count // 2] |= not buds.any()
    return np.asarray(buds)
