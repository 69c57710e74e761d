"""Fine branches that grow from a tree of vessels into the space that it leaves empty.

Space colonisation: points that need supply pull the nearest vessel towards them, and are satisfied once it is
near. A. Runions et al., "Modeling and visualization of leaf venation patterns", 2005; "Modeling trees with a
space colonization algorithm", 2007. New here: a branch keeps a part of its heading, and strays from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.arrays import Floats, Ints
from synth.render.anatomy.tree import Tree, gather
from synth.system.jit import argument_types, compiled

_MOST = 60_000  # nodes
_NEAR = 0.35  # of a step: a branch that ends nearer to its sister than this is the sister
# Cosine and sine of the widest angle at which a side branch leaves.
_FORWARD = float(np.cos(np.radians(44))), float(np.sin(np.radians(44)))
_PUSHED = 0.4  # of a step, standard deviation of what a branch strays


@dataclass(frozen=True)
class Growth:
    """How branches of one order grow; lengths in mm, pairs are ranges."""

    spacing: float  # of the points that need supply
    reach: float  # distance from which a point pulls
    kill_distance: float  # distance of a vessel that satisfies a point
    step: float
    straight: float  # weight of a branch's heading, as a multiple of the pull
    end: tuple[float, float]  # radius of the finest


def fill(tree: Tree, targets: Floats, growth: Growth, rng: np.random.Generator) -> Tree:
    """The tree with branches grown to targets (N, 2) mm; a vessel's r^3 is the sum of its branches'."""
    count = len(tree.nodes)
    capacity = max(_MOST, 2 * count)
    nodes, parent = np.zeros((capacity, 2)), np.full(capacity, -1)
    nodes[:count], parent[:count] = tree.nodes, tree.parent
    heading = np.zeros((capacity, 2))
    has_parent = tree.parent >= 0
    heading[:count][has_parent] = tree.nodes[has_parent] - tree.nodes[tree.parent[has_parent]]
    heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-12)
    targets = np.ascontiguousarray(targets)
    stray = _PUSHED * rng.standard_normal((capacity, 2))
    total = _grow(
        nodes,
        parent,
        heading,
        count,
        targets,
        stray,
        growth.reach,
        growth.kill_distance,
        growth.step,
        growth.straight,
    )
    nodes, parent = nodes[:total], parent[:total]
    cubes = np.zeros(total)
    ends = np.flatnonzero(np.bincount(parent + 1, minlength=total + 1)[1:] == 0)
    ends = ends[ends >= count]
    cubes[ends] = rng.uniform(*growth.end, len(ends)) ** 3
    radius = np.cbrt(gather(parent, cubes) + np.append(tree.radius, np.zeros(total - count)) ** 3)
    return Tree(nodes, parent, radius)


@argument_types("f8[:,::1], i8[::1], f8[:,::1], i8, f8[:,::1], f8[:,::1], f8, f8, f8, f8")
@compiled
def _grow(
    nodes: Floats,
    parent: Ints,
    heading: Floats,
    count: int,
    targets: Floats,
    stray: Floats,
    reach: float,
    kill_mm: float,
    step: float,
    straight: float,
) -> int:
    """Adds nodes to the first `count` of `nodes` (M, 2), with parents and headings; returns their number."""
    limit = len(nodes)
    total = len(targets)
    if total == 0 or count == 0:
        return count
    left, low = targets[:, 0].min(), targets[:, 1].min()
    columns = int((targets[:, 0].max() - left) / reach) + 1
    rows = int((targets[:, 1].max() - low) / reach) + 1
    first = np.zeros(columns * rows + 1, np.int64)
    cell = np.zeros(total, np.int64)
    for i in range(total):
        cell[i] = int((targets[i, 1] - low) / reach) * columns + int((targets[i, 0] - left) / reach)
        first[cell[i] + 1] += 1
    for c in range(columns * rows):
        first[c + 1] += first[c]
    order = np.argsort(cell)
    distance = np.full(total, reach)
    nearest = np.full(total, -1, np.int64)
    pull = np.zeros((limit, 2))
    child = np.full(limit, -1, np.int64)
    wave_start, wave_end = 0, 0
    while wave_start < count and count < limit:
        for k in range(wave_start, count):
            u, v = int(np.floor((nodes[k, 0] - left) / reach)), int(np.floor((nodes[k, 1] - low) / reach))
            for row in range(max(0, v - 1), min(rows, v + 2)):
                for column in range(max(0, u - 1), min(columns, u + 2)):
                    c = row * columns + column
                    for j in range(first[c], first[c + 1]):
                        i = order[j]
                        separation = np.hypot(targets[i, 0] - nodes[k, 0], targets[i, 1] - nodes[k, 1])
                        if separation < distance[i]:
                            distance[i], nearest[i] = separation, k
        wave_end = count
        for i in range(total):
            k = nearest[i]
            if k >= 0 and distance[i] > kill_mm:
                pull[k, 0] += (targets[i, 0] - nodes[k, 0]) / distance[i]
                pull[k, 1] += (targets[i, 1] - nodes[k, 1]) / distance[i]
        for i in range(total):
            k = nearest[i]
            if k < 0 or distance[i] <= kill_mm or (pull[k, 0] == 0.0 and pull[k, 1] == 0.0) or count >= limit:
                continue
            norm = np.hypot(pull[k, 0], pull[k, 1]) + 1e-9
            inertia = straight if k >= 0 and child[k] < 0 else 0.0
            x = pull[k, 0] / norm + inertia * heading[k, 0] + stray[count, 0]
            y = pull[k, 1] / norm + inertia * heading[k, 1] + stray[count, 1]
            pull[k, 0], pull[k, 1] = 0.0, 0.0
            norm = np.hypot(x, y) + 1e-9
            x, y = x / norm, y / norm
            hx, hy = heading[k, 0], heading[k, 1]
            if child[k] >= 0 and hx * hx + hy * hy > 0.5 and x * hx + y * hy < _FORWARD[0]:
                turn = _FORWARD[1] if hx * y - hy * x > 0 else -_FORWARD[1]
                x, y = _FORWARD[0] * hx - turn * hy, _FORWARD[0] * hy + turn * hx
            new_x, new_y = nodes[k, 0] + step * x, nodes[k, 1] + step * y
            c = child[k]
            if c >= 0 and np.hypot(nodes[c, 0] - new_x, nodes[c, 1] - new_y) < _NEAR * step:
                nearest[i] = -1  # left to a vessel that comes nearer
                continue
            nodes[count, 0], nodes[count, 1], parent[count] = new_x, new_y, k
            heading[count, 0], heading[count, 1] = x, y
            child[k] = count
            count += 1
        wave_start = wave_end
    return count
