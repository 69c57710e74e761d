"""Grading a tetrahedral mesh: longest-edge bisection, largest relative size first, until a count is reached.

Rivara's longest-edge bisection (Int. J. Numer. Meth. Eng. 20, 1984). On cubes cut into Kuhn's six tetrahedra
it is Maubach's bisection (SIAM J. Sci. Comput. 16, 1995), which makes three shapes only, at any depth.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from synth.arrays import Floats, Ints

EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
"""The six edges of a tetrahedron, as pairs of its corners; the order of P2's midside nodes."""


def refine(points: Floats, cells: Ints, size: Callable[[Floats], Floats], target: int) -> tuple[Floats, Ints]:
    """Bisects points (N, 3) mm and cells (M, 4), positively oriented, until there are `target` or, as closure
    conforms, a few per cent more; the first N points stay. `size`: wanted edge length at (n, 3) mm, up to a
    factor."""
    while len(cells) < target:
        relative_size = longest(points, cells) / size(points[cells].mean(axis=1))
        # Marking only the worst keeps the grading even; a handful at a time would take hundreds of rounds.
        allowance = max(1, (target - len(cells)) // 6)
        worst = np.flatnonzero(relative_size >= 0.8 * relative_size.max())
        worst = worst[np.argsort(-relative_size[worst], kind="stable")][:allowance]
        points, cells = bisect(points, cells, worst)
    return points, cells


def longest(points: Floats, cells: Ints) -> Floats:
    """Length of each tetrahedron's longest edge, (M,)."""
    corner = points[cells]
    return np.asarray(np.linalg.norm(corner[:, EDGES[:, 0]] - corner[:, EDGES[:, 1]], axis=2).max(axis=1))


def edges_of(cells: Ints) -> tuple[Ints, Ints]:
    """Edges (E, 2) of a mesh as sorted corner pairs, once each, and (M, 6) each tetrahedron's indices into
    them, in the order of `EDGES`."""
    pairs = np.sort(cells[:, EDGES].reshape(-1, 2), axis=1)
    key = pairs[:, 0] * (int(cells.max()) + 1) + pairs[:, 1]
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    return pairs[first], inverse.reshape(-1, 6)


def bisect(points: Floats, cells: Ints, chosen: Ints) -> tuple[Floats, Ints]:
    """Bisection of a mesh of points (N, 3) mm and cells (M, 4): the chosen cells (K,) are halved at their
    longest edges, and as many others as conformity requires."""
    pairs, cell_edges = edges_of(cells)
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    # One order of all edges: ties must fall alike in neighbours, or their face would be cut in two ways.
    rank = np.empty(len(pairs), np.int64)
    rank[np.lexsort((pairs[:, 1], pairs[:, 0], np.round(length, 9)))] = np.arange(len(pairs))
    longest_edge = np.take_along_axis(cell_edges, rank[cell_edges].argmax(axis=1)[:, None], axis=1)[:, 0]

    marked = np.zeros(len(pairs), bool)
    marked[longest_edge[chosen]] = True
    while True:
        closure = marked.copy()
        closure[longest_edge[marked[cell_edges].any(axis=1)]] = True
        if (closure == marked).all():
            break
        marked = closure

    split = np.flatnonzero(marked)
    stride = len(points) + len(split)
    key, touched = pairs[split] @ [stride, 1], marked[cell_edges].any(axis=1)
    done, waiting = [cells[~touched]], cells[touched]
    while len(waiting):
        edge_keys = np.sort(waiting[:, EDGES], axis=2) @ [stride, 1]
        indices = np.minimum(np.searchsorted(key, edge_keys), len(key) - 1)
        order = np.where(key[indices] == edge_keys, rank[split[indices]], -1)
        edge, row = order.argmax(axis=1), np.arange(len(waiting))
        cut = order[row, edge] >= 0
        done.append(waiting[~cut])
        edge, row = edge[cut], row[: cut.sum()]
        new_nodes = len(points) + indices[cut, edge]
        # Putting the midpoint in the place of one end keeps the orientation.
        first_half, second_half = waiting[cut], waiting[cut]
        first_half[row, EDGES[edge, 0]] = second_half[row, EDGES[edge, 1]] = new_nodes
        waiting = np.concatenate([first_half, second_half])
    midpoints = 0.5 * (points[pairs[split, 0]] + points[pairs[split, 1]])
    return np.vstack([points, midpoints]), np.concatenate(done)
