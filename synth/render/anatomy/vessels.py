"""Vessels of the pia: veins and arteries from trunks along the sulci down to the finest arterioles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from synth.render.anatomy import noise, trunk, tube
from synth.render.anatomy.tree import Tree, grow, murray, pruned, relaxed, scattered, taper

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Map = npt.NDArray[np.float32]

_STIFF_MM = 0.15  # radius of a vessel that winds half as far as the finest


@dataclass(frozen=True)
class Vessels:
    """All vessels of one anatomy."""

    veins: Tree
    arteries: Tree
    deep: Tree
    """Under the pia, seen through the tissue."""


def grow_all(sulci: Map, extent_mm: float, rng: np.random.Generator) -> Vessels:
    """Vessels that follow the sulci.

    Args:
        sulci: (n, n) depth below the gyri, 0 on a crown to 1 in a sulcus.
        extent_mm: side of the square that the map covers.
        rng: where the anatomy comes from.
    """
    many = extent_mm / 34.0
    count = round(many * rng.integers(1, 4))
    trunks, radius = trunk.trunks(
        sulci, extent_mm, rng, count, (0.55, 1.2), smooth=60, wiggle=0.0, settle=0.1
    )
    veins = _tree(extent_mm, rng, trunks, radius, spacings=(9.0, 5.5), leaf=0.1, wander=0.3)
    trunks, radius = trunk.trunks(
        sulci, extent_mm, rng, round(many * rng.integers(4, 7)), (0.2, 0.4), smooth=40, wiggle=0.12
    )
    # No gyrus has as dense a web as the next, and a wide vein has none.
    rich = 0.9 + 0.35 * noise.band(rng, 128, extent_mm, 9.0, 0.5)
    distance, width = tube.raster(veins, 128, extent_mm)
    rich = np.clip(rich, 0.3, 1.0) * ((distance > width + 0.3) | (width < 0.3))
    rich = np.asarray(rich, np.float32)
    arteries = _tree(
        extent_mm,
        rng,
        trunks,
        radius,
        spacings=(5.2, 2.6, 1.3, 0.7, 0.46),
        leaf=0.042,
        wander=0.25,
        density=rich,
        winding=0.1,
    )
    # What shimmers through the tissue is coarser than the finest of the pia.
    trunks, radius = trunk.trunks(
        sulci, extent_mm, rng, round(3 * extent_mm / 34.0), (0.1, 0.2), smooth=18, wiggle=0.2
    )
    deep = _tree(extent_mm, rng, trunks, radius, spacings=(3.6, 1.9), leaf=0.05, wander=0.35)
    return Vessels(veins, arteries, deep)


def _tree(
    extent_mm: float,
    rng: np.random.Generator,
    trunks: tuple[Floats, Ints],
    own: Floats,
    *,
    spacings: tuple[float, ...],
    leaf: float,
    wander: float,
    density: Map | None = None,
    winding: float = 0.0,
) -> Tree:
    """Branches from the trunks of radii `own` (N,) mm, then finer ones from those: a round a spacing [mm]."""
    nodes, parent = trunks
    fixed = len(nodes)
    for spacing in spacings:
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
            wander=wander,
            rng=rng,
        )
        nodes, parent = pruned(nodes, parent, grown, shortest=int(0.55 * spacing / step))
    nodes = relaxed(nodes, parent, fixed, rounds=12)
    nodes = nodes + trunk.meander(rng, nodes, extent_mm, 0.3, 0.22)
    radius = murray(parent, leaf) * taper(nodes, parent, 1.6)
    radius[:fixed] = np.maximum(np.minimum(radius[:fixed], 1.3 * own), own)
    swell = 1 + 0.15 * noise.sample(noise.band(rng, 256, extent_mm, 2.0, 0.5), nodes[fixed:], extent_mm)
    radius[fixed:] = np.minimum(radius[fixed:] * np.clip(swell, 0.6, 1.4), 0.8 * own.max())
    if winding:
        nodes = nodes + _wound(rng, nodes, radius, extent_mm, winding)
    return Tree(nodes, parent, radius)


def _wound(
    rng: np.random.Generator, nodes: Floats, radius: Floats, extent_mm: float, amplitude: float
) -> Floats:
    """Shift (N, 2) mm that makes vessels wind in bends of a millimetre or two, the wide ones less."""
    bends = [noise.sample(noise.band(rng, 256, extent_mm, 1.7, 0.35), nodes, extent_mm) for _ in range(2)]
    stiff = 1 / (1 + (radius / _STIFF_MM) ** 2)
    return np.asarray(amplitude * stiff[:, None] * np.stack(bends, axis=1), np.float64)


def _sprouting(count: int, share: float, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """A random share of nodes, and one at least: short trunks have few."""
    buds = rng.random(count) < share
    buds[count // 2] |= not buds.any()
    return np.asarray(buds)
