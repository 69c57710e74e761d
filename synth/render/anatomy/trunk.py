"""Trunks of vessels: smooth paths across the patch that follow the sulci.

Costs of a path, and variations of widths and bends, were chosen by eye on an intra-operative photograph.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from synth.arrays import Floats, Ints, Map
from synth.render.anatomy import noise

_SHORTEST = 8  # steps of a path: a shorter one joins another vessel at once and is dropped


def trunks(
    sulci: Map,
    extent_mm: float,
    rng: np.random.Generator,
    count: int,
    radius: tuple[float, float],
    *,
    smooth: int,
    wiggle: float,
    settle: float = 0.0,
) -> tuple[tuple[Floats, Ints], Floats]:
    """Paths across the square along the sulci, as nodes with parents, and the trunk radius of each node.

    A path that meets an earlier one ends there and springs from it: vessels join, they don't cross.

    Args:
        sulci: (n, n) 0 on a crown to 1 in a sulcus.
        extent_mm: side of the square.
        rng: of the anatomy.
        count: number of trunks.
        radius: range of a trunk's radius [mm].
        smooth: rounds of smoothing; thick vessels bend in wider curves.
        wiggle: share of short bends in the path.
        settle: mm by which a round of smoothing also moves the path into the nearest cleft.
    """
    side = 72
    depth = cv2.resize(sulci, (side, side), interpolation=cv2.INTER_AREA)
    across, along = np.gradient(noise.blur(depth, 0.5, extent_mm), extent_mm / side)
    downhill = np.dstack([along, across]).astype(np.float32)
    nodes, parents, radii = np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0)
    taken = np.zeros((side, side), np.float32)
    for trunk in range(max(1, count)):
        # A pixel of a cleft costs 0.12, of a crown 1 more, by chance up to 0.35, and 2.5 where a vessel runs.
        cost = 0.12 + (1 - np.clip(depth, 0, 1)) ** 2 + 0.35 * rng.random((side, side)) + 2.5 * taken
        angle = rng.uniform(0, 2 * np.pi) + trunk * 2 * np.pi / count
        turn = rng.uniform(0.6, 1.0) * np.pi
        path = _cheapest(cost, _border(angle, side), _border(angle + turn, side))
        line = ((path + 0.5) / side - 0.5) * extent_mm
        line, root = _joined(line, nodes, 0.04 * extent_mm)
        if len(line) < _SHORTEST:
            continue
        pixel = np.rint((line / extent_mm + 0.5) * side - 0.5).astype(int)
        taken[pixel[:, 1], pixel[:, 0]] = 1.0
        taken = np.maximum(taken, cv2.GaussianBlur(taken, (0, 0), 1.5))
        for _ in range(smooth):
            line = _smoothed(line + settle * noise.sample(downhill, line, extent_mm))
        line = _resampled(line, 0.18)
        line = line + meander(rng, line, extent_mm, 0.55, wiggle)
        own = rng.uniform(*radius)
        if root >= 0:
            along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
            line = line + np.exp(-along / (0.1 * extent_mm))[:, None] * (nodes[root] - line[0])
            own = min(own, rng.uniform(0.6, 0.85) * radii[root])
        taper = np.linspace(1.0, rng.uniform(0.55, 0.85), len(line))
        # A vessel's width varies along it.
        swell = 1 + 0.1 * noise.sample(noise.band(rng, 128, extent_mm, 6.0, 0.5), line, extent_mm)
        parents = np.concatenate([parents, [root], np.arange(len(line) - 1) + len(nodes)])
        nodes = np.concatenate([nodes, line])
        radii = np.concatenate([radii, own * taper * np.clip(swell, 0.75, 1.3)])
    return (nodes, parents.astype(np.int64)), radii


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


def meander(
    rng: np.random.Generator, points: Floats, extent_mm: float, amplitude: float, wiggle: float
) -> Floats:
    """A smooth random shift (n, 2) mm of points (n, 2) mm; `wiggle` is the share of short bends."""
    shifts = []
    for _ in range(2):
        long = noise.band(rng, 128, extent_mm, 9.0, 0.3)
        short = noise.band(rng, 128, extent_mm, 3.0, 0.3)
        shifts.append(amplitude * (0.6 * noise.sample(long, points, extent_mm)))
        shifts[-1] = shifts[-1] + amplitude * wiggle * noise.sample(short, points, extent_mm)
    return np.stack(shifts, axis=1).astype(np.float64)


def _border(angle: float, side: int) -> tuple[int, int]:
    """Pixel (x, y) on the square's border in a direction from its centre."""
    direction = np.array([np.cos(angle), np.sin(angle)])
    point = direction / np.abs(direction).max() * (side - 1) / 2 + (side - 1) / 2
    return round(float(point[0])), round(float(point[1]))


def _cheapest(cost: Floats, start: tuple[int, int], end: tuple[int, int]) -> Floats:
    """Cheapest path (L, 2) of pixels x, y over a square cost map, diagonals allowed."""
    side = len(cost)
    index = np.arange(side * side).reshape(side, side)
    rows, columns, weights = [], [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = index[: side - dy, max(0, -dx) : side - max(0, dx)]
        b = index[dy:, max(0, dx) : side + min(0, dx)]
        rows.append(a.ravel())
        columns.append(b.ravel())
        weights.append((0.5 * (cost.ravel()[a] + cost.ravel()[b]) * np.hypot(dx, dy)).ravel())
    graph = coo_array(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=(side**2, side**2)
    ).tocsr()
    source, goal = start[1] * side + start[0], end[1] * side + end[0]
    before = dijkstra(graph, directed=False, indices=source, return_predecessors=True)[1]
    path = [goal]
    while path[-1] != source:
        path.append(int(before[path[-1]]))
    return np.array([(p % side, p // side) for p in reversed(path)], dtype=np.float64)


def _smoothed(line: Floats) -> Floats:
    return np.concatenate([line[:1], 0.25 * line[:-2] + 0.5 * line[1:-1] + 0.25 * line[2:], line[-1:]])


def _resampled(line: Floats, spacing: float) -> Floats:
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0, along[-1], max(2, int(along[-1] / spacing)))
    return np.stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)], axis=1)
