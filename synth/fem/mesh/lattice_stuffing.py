"""Tetrahedra inside any surface, by isosurface stuffing of a graded lattice; deterministic.

After Labelle & Shewchuk, "Isosurface stuffing" (ACM Trans. Graph. 26, 2007): lattice corners close to the
surface move onto it, tetrahedra that still cross it are cut. Their lattice is an octree's, ours Kuhn's.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from synth.arrays import Floats, Ints, Mask
from synth.fem.mesh.element import bary_slope
from synth.fem.mesh.refine import edges_of

_SNAP = 0.3  # largest shift of a corner, in edges; less leaves flat pieces, more flattens neighbours
_HALVINGS = 14


def stuff(points: Floats, cells: Ints, inside: Callable[[Floats], Floats]) -> tuple[Floats, Ints]:
    """Cuts a lattice along a surface, and returns points and cells of the largest connected part inside it.

    `points`: (N, 3) mm, corners; `cells`: (M, 4), positively oriented; `inside`: positive inside and negative
    outside, at (n, 3) mm.
    """
    points, value = points.copy(), np.where(inside(points) > 0, 1, -1)
    cells = cells[(value[cells] > 0).any(axis=1)]
    pairs, _ = edges_of(cells)
    pairs = pairs[value[pairs[:, 0]] != value[pairs[:, 1]]]
    crossing = _find_crossings(points, pairs, value, inside)
    _snap(points, value, pairs, crossing)

    # A new corner on each edge that is still cut.
    is_cut = value[pairs[:, 0]] * value[pairs[:, 1]] < 0
    pairs = pairs[is_cut]
    crossing = _find_crossings(points, pairs, value, inside)
    cut_points = points[pairs[:, 0]] + crossing[:, None] * (points[pairs[:, 1]] - points[pairs[:, 0]])
    cut_corners = {(int(a), int(b)): len(points) + i for i, (a, b) in enumerate(pairs)}
    points = np.vstack([points, cut_points])

    sign = value[cells]
    is_inner = (sign >= 0).all(axis=1) & (sign > 0).any(axis=1)
    is_mixed = (sign < 0).any(axis=1) & (sign > 0).any(axis=1)
    pieces = [piece for cell in cells[is_mixed] for piece in _pieces(cell, value, cut_corners)]
    cells = np.vstack([cells[is_inner], np.array(pieces, np.int64).reshape(-1, 4)])
    return _clean(points, cells)


def _find_crossings(points: Floats, pairs: Ints, value: Ints, inside: Callable[[Floats], Floats]) -> Floats:
    """Crossing of each edge with the surface, (E,) from 0 at its first corner to 1."""
    first, side = points[pairs[:, 0]], points[pairs[:, 1]] - points[pairs[:, 0]]
    ends = np.zeros(len(pairs)), np.ones(len(pairs))
    return halve(inside, first, side, value[pairs[:, 0]] > 0, *ends, _HALVINGS)


def halve(
    inside: Callable[[Floats], Floats],
    start: Floats,
    ray: Floats,
    is_inside: Mask,
    low: Floats,
    high: Floats,
    times: int,
) -> Floats:
    """Share (n,) between `low` and `high` (n,) at which `start` + share * `ray`, (n, 3) mm, crosses the
    surface, by bisection; `is_inside`: (n,) whether `low` is inside."""
    for _ in range(times):
        middle = 0.5 * (low + high)
        is_before = (inside(start + middle[:, None] * ray) > 0) == is_inside
        low, high = np.where(is_before, middle, low), np.where(is_before, high, middle)
    return 0.5 * (low + high)


def _snap(points: Floats, value: Ints, pairs: Ints, crossing: Floats) -> None:
    """Moves corners close to the surface onto it, in place, the closest first; their value becomes 0."""
    ends = np.concatenate([pairs[:, 0], pairs[:, 1]])
    share = np.concatenate([crossing, 1 - crossing])
    length = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    target = points[pairs[:, 0]] + crossing[:, None] * (points[pairs[:, 1]] - points[pairs[:, 0]])
    candidates = np.flatnonzero(share < _SNAP)
    order = candidates[np.lexsort((candidates, share[candidates] * np.tile(length, 2)[candidates]))]
    _, first = np.unique(ends[order], return_index=True)
    chosen = order[np.sort(first)]
    points[ends[chosen]] = target[chosen % len(pairs)]
    value[ends[chosen]] = 0


def _pieces(cell: Ints, value: Ints, cut_corners: dict[tuple[int, int], int]) -> list[list[int]]:
    """The inner part of a cut tetrahedron, as tetrahedra of any orientation."""

    def cut(a: int, b: int) -> int:
        return cut_corners[(a, b) if a < b else (b, a)]

    ins = [int(v) for v in cell if value[v] > 0]
    zero = [int(v) for v in cell if value[v] == 0]
    outs = [int(v) for v in cell if value[v] < 0]
    if len(ins) == 1:
        return [[ins[0], *zero, *(cut(ins[0], o) for o in outs)]]
    if len(ins) == 3:  # a corner is off: what is left is a prism
        return _prism([ins, [cut(i, outs[0]) for i in ins]])
    a, b = ins
    if len(outs) == 2:
        return _prism([[a, cut(a, outs[0]), cut(a, outs[1])], [b, cut(b, outs[0]), cut(b, outs[1])]])
    # Two inside, one on the surface, one outside: a pyramid over a quadrilateral, its top on the surface.
    return _pyramid([a, b, cut(b, outs[0]), cut(a, outs[0])], zero[0])


def _pyramid(base: list[int], top: int) -> list[list[int]]:
    """Two tetrahedra; the base is halved from its lowest corner, as in the neighbour behind it."""
    k = base.index(min(base))
    a, b, c, d = base[k:] + base[:k]
    return [[a, b, c, top], [a, c, d, top]]


def _prism(ends: list[list[int]]) -> list[list[int]]:
    """Three tetrahedra; every quadrilateral is halved from its lowest corner, as in its neighbour."""
    if min(ends[1]) < min(ends[0]):
        ends = ends[::-1]
    k = ends[0].index(min(ends[0]))
    (a, b, c), (d, e, f) = (end[k:] + end[:k] for end in ends)
    # a is the lowest of all: both quadrilaterals at it are halved from it; the third is left.
    return [[a, d, e, f], *_pyramid([b, c, f, e], a)]


def _clean(points: Floats, cells: Ints) -> tuple[Floats, Ints]:
    """The largest connected part of the cells, positively oriented, without flat cells and unused corners."""
    if len(cells) == 0:
        return np.zeros((0, 3)), np.zeros((0, 4), np.int64)
    corner = points[cells]
    volume = np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6
    cells[volume < 0] = cells[volume < 0][:, [0, 2, 1, 3]]
    span = np.ptp(corner, axis=1).max(axis=1)
    cells = cells[np.abs(volume) > 1e-6 * span**3]
    faces = np.sort(cells[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    _, face = np.unique(faces, axis=0, return_inverse=True)
    links = sp.csr_array(
        (np.ones(len(face)), (np.repeat(np.arange(len(cells)), 4), face.ravel())),
        shape=(len(cells), int(face.max()) + 1),
    )
    _, part = connected_components(links @ links.T, directed=False)
    size = np.bincount(part, np.abs(bary_slope(points[cells])[1]))
    cells = cells[part == size.argmax()]
    used, cells = np.unique(cells, return_inverse=True)
    return points[used], cells.reshape(-1, 4)
