"""Vessels of the pia: veins and arteries from trunks along the sulci down to the finest arterioles.

All numbers were chosen by eye on an intra-operative photograph.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from synth.arrays import Floats, Map
from synth.render.anatomy import noise, tube
from synth.render.anatomy.tree import Tree, grow, murray, pruned, relaxed, scattered, taper

_STIFF_MM = 0.15  # radius of a vessel that winds half as far as the finest
_PATCH_MM = 34.0  # side of the patch that `Kind.trunks` are counted on
_GRID = 72  # side of the grid on which trunks are routed
_SHORTEST = 8  # steps of a trunk: a shorter one joins another vessel at once and is dropped


@dataclass(frozen=True)
class Kind:
    """Growth of one kind of vessel; lengths in mm."""

    trunks: tuple[int, int]  # least number, and one more than the largest
    radius: tuple[float, float]  # of a trunk
    smooth: int  # rounds of smoothing over a trunk: thick vessels bend in wider curves
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
    """Vessels of a square patch, along its sulci (n, n): 0 on a crown to 1 in a sulcus."""
    veins = _branched(VEINS, _trunks(VEINS, sulci, extent_mm, rng), extent_mm, rng)
    trunks = _trunks(ARTERIES, sulci, extent_mm, rng)
    # The density of arteries varies between gyri, and is 0 on a wide vein.
    rich = 0.9 + 0.35 * noise.band(rng, 128, extent_mm, 9.0, 0.5)
    distance, width = tube.raster(veins, 128, extent_mm)
    rich = np.clip(rich, 0.3, 1.0) * ((distance > width + 0.3) | (width < 0.3))
    arteries = _branched(ARTERIES, trunks, extent_mm, rng, np.asarray(rich, np.float32))
    deep = _branched(DEEP, _trunks(DEEP, sulci, extent_mm, rng), extent_mm, rng)
    return Vessels(veins, arteries, deep)


def _trunks(kind: Kind, sulci: Map, extent_mm: float, rng: np.random.Generator) -> Tree:
    """Paths across the square along the sulci.

    A path that meets an earlier one ends there and springs from it: vessels join, they don't cross.
    """
    count = round(extent_mm / _PATCH_MM * rng.integers(*kind.trunks))
    depth = cv2.resize(sulci, (_GRID, _GRID), interpolation=cv2.INTER_AREA)
    across, along = np.gradient(noise.blur(depth, 0.5, extent_mm), extent_mm / _GRID)
    downhill = np.dstack([along, across]).astype(np.float32)
    nodes, parents, radii = np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0)
    taken = np.zeros((_GRID, _GRID), np.float32)
    for trunk in range(max(1, count)):
        # A pixel of a cleft costs 0.12, of a crown 1 more, by chance up to 0.35, and 2.5 where a vessel runs.
        cost = 0.12 + (1 - np.clip(depth, 0, 1)) ** 2 + 0.35 * rng.random((_GRID, _GRID)) + 2.5 * taken
        angle = rng.uniform(0, 2 * np.pi) + trunk * 2 * np.pi / count
        turn = rng.uniform(0.6, 1.0) * np.pi
        path = _cheapest(cost, _border(angle), _border(angle + turn))
        line = ((path + 0.5) / _GRID - 0.5) * extent_mm
        line, root = _joined(line, nodes, 0.04 * extent_mm)
        if len(line) < _SHORTEST:
            continue
        pixel = np.rint((line / extent_mm + 0.5) * _GRID - 0.5).astype(int)
        taken[pixel[:, 1], pixel[:, 0]] = 1.0
        taken = np.maximum(taken, cv2.GaussianBlur(taken, (0, 0), 1.5))
        for _ in range(kind.smooth):
            line = line + kind.settle * noise.sample(downhill, line, extent_mm)
            line[1:-1] = 0.25 * line[:-2] + 0.5 * line[1:-1] + 0.25 * line[2:]
        length = _lengths(line)
        at = np.linspace(0, length[-1], max(2, int(length[-1] / 0.18)))
        line = np.stack([np.interp(at, length, line[:, axis]) for axis in (0, 1)], axis=1)
        line = line + _meander(rng, line, extent_mm, 0.55, kind.wiggle)
        own = rng.uniform(*kind.radius)
        if root >= 0:
            line = line + np.exp(-_lengths(line) / (0.1 * extent_mm))[:, None] * (nodes[root] - line[0])
            own = min(own, rng.uniform(0.6, 0.85) * radii[root])
        thinner = np.linspace(1.0, rng.uniform(0.55, 0.85), len(line))
        # A vessel's width varies along it.
        swell = 1 + 0.1 * noise.sample(noise.band(rng, 128, extent_mm, 6.0, 0.5), line, extent_mm)
        parents = np.concatenate([parents, [root], np.arange(len(line) - 1) + len(nodes)])
        nodes = np.concatenate([nodes, line])
        radii = np.concatenate([radii, own * thinner * np.clip(swell, 0.75, 1.3)])
    return Tree(nodes, parents.astype(np.int64), radii)


def _branched(
    kind: Kind, trunks: Tree, extent_mm: float, rng: np.random.Generator, density: Map | None = None
) -> Tree:
    """A tree from trunks: branches, then finer ones from those, a round per spacing."""
    nodes, parent, own = trunks.nodes, trunks.parent, trunks.radius
    fixed = len(nodes)
    for spacing in kind.spacings:
        step = 0.15 * min(spacing, 1.6)
        grown = len(nodes)
        between = float(np.linalg.norm(nodes[1] - nodes[0]))
        attractors = scattered(extent_mm, spacing, rng, density)
        buds = rng.random(grown) < between / (0.9 * spacing)
        buds[grown // 2] |= not buds.any()
        how = {"step": step, "kill": 0.5 * spacing, "wander": kind.wander}
        nodes, parent = grow(nodes, parent, attractors, buds=buds, rng=rng, **how)
        nodes, parent = pruned(nodes, parent, grown, shortest=int(0.55 * spacing / step))
    nodes = relaxed(nodes, parent, fixed, rounds=12)
    nodes = nodes + _meander(rng, nodes, extent_mm, 0.3, 0.22)
    radius = murray(parent, kind.leaf) * taper(nodes, parent, 1.6)
    radius[:fixed] = np.maximum(np.minimum(radius[:fixed], 1.3 * own), own)
    swell = 1 + 0.15 * noise.sample(noise.band(rng, 256, extent_mm, 2.0, 0.5), nodes[fixed:], extent_mm)
    radius[fixed:] = np.minimum(radius[fixed:] * np.clip(swell, 0.6, 1.4), 0.8 * own.max())
    if kind.winding:  # bends of one or two millimetres, of wide vessels less
        bends = [noise.sample(noise.band(rng, 256, extent_mm, 1.7, 0.35), nodes, extent_mm) for _ in range(2)]
        stiff = 1 / (1 + (radius / _STIFF_MM) ** 2)
        nodes = nodes + kind.winding * stiff[:, None] * np.stack(bends, axis=1)
    return Tree(nodes, parent, radius)


def _joined(line: Floats, nodes: Floats, near: float) -> tuple[Floats, int]:
    """The part of a path from where it meets earlier nodes, and that node's index; else all of it and -1.

    Of the path's two free ends the longer one remains.
    """
    if not len(nodes):
        return line, -1
    away, which = cKDTree(nodes).query(line)
    met = np.flatnonzero(away < near)
    if not len(met):
        return line, -1
    before, after = line[: met[0] + 1], line[met[-1] :]
    if len(before) >= len(after):
        return before[::-1], int(which[met[0]])
    return after, int(which[met[-1]])


def _meander(
    rng: np.random.Generator, points: Floats, extent_mm: float, amplitude: float, wiggle: float
) -> Floats:
    """A smooth random shift (n, 2) mm of points (n, 2) mm; `wiggle` is the share of short bends."""
    shifts = []
    for _ in range(2):
        long, short = (noise.band(rng, 128, extent_mm, wavelength, 0.3) for wavelength in (9.0, 3.0))
        shift = amplitude * (0.6 * noise.sample(long, points, extent_mm))
        shifts.append(shift + amplitude * wiggle * noise.sample(short, points, extent_mm))
    return np.stack(shifts, axis=1).astype(np.float64)


def _lengths(line: Floats) -> Floats:
    """Length (L,) mm of a path (L, 2) mm up to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def _border(angle: float) -> tuple[int, int]:
    """Pixel (x, y) on the grid's border in a direction from its centre."""
    direction = np.array([np.cos(angle), np.sin(angle)])
    point = direction / np.abs(direction).max() * (_GRID - 1) / 2 + (_GRID - 1) / 2
    return round(float(point[0])), round(float(point[1]))


def _cheapest(cost: Floats, start: tuple[int, int], end: tuple[int, int]) -> Floats:
    """Cheapest path (L, 2) of pixels x, y over a square cost map, diagonals allowed."""
    side = len(cost)
    index = np.arange(side * side).reshape(side, side)
    links = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = index[: side - dy, max(0, -dx) : side - max(0, dx)].ravel()
        b = index[dy:, max(0, dx) : side + min(0, dx)].ravel()
        links.append((a, b, 0.5 * (cost.ravel()[a] + cost.ravel()[b]) * np.hypot(dx, dy)))
    rows, columns, weights = (np.concatenate(part) for part in zip(*links, strict=True))
    graph = coo_array((weights, (rows, columns)), shape=(side**2, side**2)).tocsr()
    source, goal = start[1] * side + start[0], end[1] * side + end[0]
    before = dijkstra(graph, directed=False, indices=source, return_predecessors=True)[1]
    path = [goal]
    while path[-1] != source:
        path.append(int(before[path[-1]]))
    return np.array([(p % side, p // side) for p in reversed(path)], dtype=np.float64)
