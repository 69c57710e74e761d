"""Trees of vessels grown by space colonisation, with radii by Murray's law.

A. Runions, B. Lane, P. Prusinkiewicz, "Modeling trees with a space colonization algorithm", 2007.
C. D. Murray, "The physiological principle of minimum work", 1926: r^3 of a parent is its children's sum.
Other numbers were chosen by eye on an intra-operative photograph.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from synth.arrays import Floats, Ints, Map, Mask
from synth.render.anatomy import noise

_REACH_MM = 9.0  # range of an attractor
_INERTIA = 1.2  # weight of a twig's own direction: it bends rather than turning abruptly


@dataclass(frozen=True)
class Tree:
    """One kind of vessel as segments: each node is joined to its parent, which comes before it."""

    nodes: Floats  # (N, 2) mm
    parent: Ints  # (N,) index of the parent; -1 at a root
    radius: Floats  # (N,) mm


def grow(
    nodes: Floats,
    parent: Ints,
    attractors: Floats,
    *,
    buds: Mask,
    step: float,
    kill: float,
    wander: float,
    rng: np.random.Generator,
) -> tuple[Floats, Ints]:
    """Space colonisation: nodes step towards the attractors nearest to them until none is left in reach.

    `nodes` (N, 2) mm, `parent` (N,): where growth starts; `buds` (N,): which of them may sprout, new ones all
    may; `attractors`: (A, 2) mm; `step`, `kill`: length of a segment, distance within which an attractor is
    used up [mm]; `wander`: random share of a step's direction. Returns all nodes (M, 2) and parents (M,).
    """
    all_nodes, all_parent = [nodes], [parent]
    distance, nearest = cKDTree(nodes[buds]).query(attractors)
    nearest = np.flatnonzero(buds)[nearest]
    # A trunk supplies what is next to it, also where it has no bud.
    distance = np.where(cKDTree(nodes).query(attractors)[0] < kill, 0.0, distance)
    children = np.bincount(parent[parent >= 0], minlength=len(nodes))
    heading = np.zeros((len(nodes), 2))  # of new nodes; those at the start sprout to any side
    for _ in range(int(4 * _REACH_MM / step) + 400):
        keep = distance > kill
        attractors, distance, nearest = attractors[keep], distance[keep], nearest[keep]
        pulls = distance < _REACH_MM
        if not pulls.any():
            break
        positions = np.concatenate(all_nodes)
        pulled, direction = _pulls(nearest[pulls], attractors[pulls] - positions[nearest[pulls]])
        direction += _INERTIA * heading[pulled] + wander * rng.standard_normal(direction.shape)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        # A node pulled evenly from two sides would sprout the same twig again and again.
        free = children[pulled] < 3
        distance = np.where(np.isin(nearest, pulled[~free]), 0.0, distance)
        if not free.any():
            continue
        sprouts = positions[pulled[free]] + step * direction[free]
        children[pulled[free]] += 1
        children = np.concatenate([children, np.zeros(len(sprouts), children.dtype)])
        heading = np.concatenate([heading, direction[free]])
        all_nodes.append(sprouts)
        all_parent.append(pulled[free])
        near, which = cKDTree(sprouts).query(attractors)
        closer = (near < distance) & (distance > 0)
        distance = np.where(closer, near, distance)
        nearest = np.where(closer, which + len(positions), nearest)
    return np.concatenate(all_nodes), np.concatenate(all_parent)


def _pulls(nearest: Ints, toward: Floats) -> tuple[Ints, Floats]:
    """Nodes (P,) with attractors, and the unit mean (P, 2) of the directions to theirs, by the nearest node
    (A,) of each and the way (A, 2) mm to it."""
    toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    pulled, index = np.unique(nearest, return_inverse=True)
    mean = np.stack([np.bincount(index, toward[:, axis]).astype(np.float64) for axis in (0, 1)], axis=1)
    return pulled, mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)


def murray(parent: Ints, leaf: float) -> Floats:
    """Radii (N,) mm by Murray's law from leaves of radius `leaf`; parents come before children."""
    up = parent.tolist()
    cubes = [0.0] * len(up)
    for node in range(len(up) - 1, -1, -1):
        cubes[node] = cubes[node] or leaf**3
        if up[node] >= 0:
            cubes[up[node]] += cubes[node]
    return np.asarray(np.cbrt(np.asarray(cubes)), np.float64)


def taper(nodes: Floats, parent: Ints, length: float) -> Floats:
    """Factor (N,) by which vessels thin over the last `length` mm before their ends."""
    up = parent.tolist()
    segment = np.linalg.norm(nodes - nodes[np.maximum(parent, 0)], axis=1).tolist()
    left = [0.0] * len(up)
    for node in range(len(up) - 1, -1, -1):
        if up[node] >= 0:
            left[up[node]] = max(left[up[node]], left[node] + segment[node])
    return np.asarray(0.45 + 0.55 * np.clip(np.asarray(left) / length, 0, 1))


def pruned(nodes: Floats, parent: Ints, fixed: int, shortest: int) -> tuple[Floats, Ints]:
    """Nodes (N, 2) mm and parents (N,), without side twigs of fewer than `shortest` nodes."""
    links = parent.tolist()
    reach = [1] * len(links)
    for node in range(len(links) - 1, -1, -1):
        if links[node] >= 0:
            reach[links[node]] = max(reach[links[node]], reach[node] + 1)
    keep = [True] * len(links)
    for node in range(fixed, len(links)):
        up = links[node]
        side_twig = up < fixed or reach[node] + 1 < reach[up]
        keep[node] = keep[up] and not (side_twig and reach[node] < shortest)
    number = np.cumsum(keep) - 1
    parent = parent[keep]
    return nodes[keep], np.where(parent >= 0, number[parent], -1)


def scattered(
    extent_mm: float, spacing: float, rng: np.random.Generator, density: Map | None = None
) -> Floats:
    """Points (n, 2) mm about `spacing` mm apart: a jittered grid, which neither clumps nor lines up, of which
    a share `density` (m, m) stays."""
    side = max(1, int(extent_mm / spacing))
    cell = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    points = ((cell + rng.random(cell.shape)) / side - 0.5) * extent_mm
    if density is None:
        return points
    return points[rng.random(len(points)) < noise.sample(density, points, extent_mm)]


def relaxed(nodes: Floats, parent: Ints, fixed: int, rounds: int) -> Floats:
    """Nodes (N, 2) mm, those after the first `fixed` smoothed towards their neighbours."""
    has = np.flatnonzero(parent >= 0)
    for _ in range(rounds):
        total, count = np.zeros_like(nodes), np.zeros(len(nodes))
        for one, neighbour in ((has, parent[has]), (parent[has], has)):
            np.add.at(total, one, nodes[neighbour])
            np.add.at(count, one, 1)
        moved = 0.5 * nodes + 0.5 * total / np.maximum(count, 1)[:, None]
        inner = (np.arange(len(nodes)) >= fixed) & (count > 1)
        nodes = np.where(inner[:, None], moved, nodes)
    return nodes
