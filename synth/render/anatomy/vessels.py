"""Vessels of the pia: veins and arteries from trunks along the sulci, and the web of their finest twigs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from synth.render.anatomy import trunk
from synth.render.anatomy.tree import Tree, grow, murray, pruned, relaxed, scattered, taper

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Map = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Vessels:
    """All vessels of one anatomy."""

    veins: Tree
    arteries: Tree
    capillaries: Tree


def grow_all(sulci: Map, extent_mm: float, rng: np.random.Generator) -> Vessels:
    """Vessels that follow the sulci.

    Args:
        sulci: (n, n) depth below the gyri, 0 on a crown to 1 in a sulcus.
        extent_mm: side of the square that the map covers.
        rng: where the anatomy comes from.
    """
    many = extent_mm / 34.0
    trunks, radius = trunk.trunks(
        sulci, extent_mm, rng, round(many * rng.integers(1, 3)), (0.6, 1.2), smooth=60, wiggle=0.0
    )
    veins = _tree(extent_mm, rng, trunks, spacings=(6.5,), leaf=0.13, wander=0.35)
    veins = _widen(veins, radius)
    trunks, radius = trunk.trunks(
        sulci, extent_mm, rng, round(many * rng.integers(3, 6)), (0.2, 0.38), smooth=18, wiggle=0.12
    )
    arteries = _tree(extent_mm, rng, trunks, spacings=(4.2, 2.0, 1.15), leaf=0.05, wander=0.42)
    arteries = _widen(arteries, radius)
    return Vessels(veins, arteries, _web(arteries, extent_mm, rng))


def _tree(
    extent_mm: float,
    rng: np.random.Generator,
    trunks: tuple[Floats, Ints],
    *,
    spacings: tuple[float, ...],
    leaf: float,
    wander: float,
) -> Tree:
    """Branches from the trunks, then finer ones from those, one round for each spacing [mm]."""
    nodes, parent = trunks
    fixed = len(nodes)
    for spacing in spacings:
        step = 0.15 * min(spacing, 1.6)
        between = np.linalg.norm(nodes[1] - nodes[0])
        grown = len(nodes)
        nodes, parent = grow(
            nodes,
            parent,
            scattered(extent_mm, spacing, rng),
            buds=_sprouting(grown, float(between) / (1.3 * spacing), rng),
            step=step,
            reach=9.0,
            kill=0.5 * spacing,
            wander=wander,
            rng=rng,
        )
        nodes, parent = pruned(nodes, parent, grown, shortest=int(0.7 * spacing / step))
    nodes = relaxed(nodes, parent, fixed, rounds=4)
    nodes = nodes + trunk.meander(rng, nodes, extent_mm, 0.3, 0.22)
    return Tree(nodes, parent, murray(parent, leaf) * taper(nodes, parent, 1.6))


def _web(arteries: Tree, extent_mm: float, rng: np.random.Generator) -> Tree:
    """Twigs finer than the arteries' own, grown from them into what they left empty."""
    fixed = len(arteries.nodes)
    nodes, parent = grow(
        arteries.nodes,
        arteries.parent,
        scattered(extent_mm, 0.55, rng),
        buds=_sprouting(fixed, 0.25, rng),
        step=0.13,
        reach=2.4,
        kill=0.27,
        wander=0.45,
        rng=rng,
    )
    nodes = relaxed(nodes, parent, fixed, rounds=3)
    radius = np.minimum(murray(parent, 0.028), 0.06) * taper(nodes, parent, 0.8)
    # Only the twigs and what they spring from: the arteries are drawn on their own.
    drawn = np.arange(len(nodes)) >= fixed
    drawn[parent[fixed:]] = True
    number = np.cumsum(drawn) - 1
    up = np.where(np.arange(len(nodes)) >= fixed, number[parent], -1)
    return Tree(nodes[drawn], up[drawn], radius[drawn])


def _sprouting(count: int, share: float, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """A random share of nodes, and one at least: short trunks have few."""
    buds = rng.random(count) < share
    buds[count // 2] |= not buds.any()
    return np.asarray(buds)


def _widen(tree: Tree, trunk: Floats) -> Tree:
    radius = tree.radius.copy()
    radius[: len(trunk)] = np.maximum(np.minimum(radius[: len(trunk)], 1.3 * trunk), trunk)
    widest = trunk.max()
    radius[len(trunk) :] = np.minimum(radius[len(trunk) :], 0.8 * widest)
    return Tree(tree.nodes, tree.parent, radius)
