"""Static condensation: the stiffness of a mesh as felt at some of its nodes, the others moving freely.

With k the kept and e the eliminated degrees of freedom, S = K_kk - K_ke K_ee^-1 K_ek. Eliminated nodes are
divided by planes into halves and what separates them (nested dissection: George, SIAM J. Numer. Anal. 10,
1973), each separator after its halves, in dense matrices of what it touches (Duff & Reid, ACM Trans. Math.
Softw. 9, 1983). SuperLU has no such result: with one solve per kept degree of freedom it takes ten times as
long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.blas import dsyrk

from synth.arrays import Floats, Ints, Mask

_LEAF = 60  # nodes that are not divided further
_TILE = 128


def condense(stiffness: sp.csr_array, points: Floats, cells: Ints, kept: Ints, fixed: Mask) -> Floats:
    """The stiffness (3 K, 3 K) mN/mm at the nodes `kept` (K,), in their order, with all others eliminated.

    Args:
        stiffness: (3 N, 3 N) mN/mm, symmetric, degrees of freedom node by node, between nodes of one element.
        points: (N, 3) mm; they only decide the order of elimination.
        cells: (M, n) nodes of the elements, corners first.
        kept: indices of nodes, none of them fixed.
        fixed: (N,) nodes that cannot move.

    Raises:
        LinAlgError: the eliminated part is not positive definite, as nothing holds it.
    """
    inner = ~fixed
    inner[kept] = False
    centre = points[cells[:, :4]].mean(axis=1)
    mesh = _Mesh(sp.csr_array(stiffness), cells, centre, fixed, np.full(3 * len(points), -1, np.int64))
    front = mesh.eliminate(np.arange(len(cells)), np.flatnonzero(inner))
    whole = mesh.entries(kept, kept)
    order = np.argsort(kept)
    place = degrees_of_freedom(order[np.searchsorted(kept, front.nodes, sorter=order)])
    whole[np.ix_(place, place)] += front.update
    return whole


@dataclass(frozen=True, eq=False)
class _Front:
    """What an eliminated part of the mesh adds to the stiffness of the nodes around it."""

    nodes: Ints  # (B,)
    update: Floats  # (3 B, 3 B) mN/mm


@dataclass(frozen=True, eq=False)
class _Mesh:
    stiffness: sp.csr_array  # (3 N, 3 N)
    cells: Ints  # (M, n)
    centre: Floats  # (M, 3) of the elements
    fixed: Mask  # (N,)
    column: Ints  # (3 N,) scratch of `entries`, -1 between its calls

    def eliminate(self, elements: Ints, inner: Ints) -> _Front:
        """Eliminates the nodes `inner`, which only these elements touch: half by half, then those between."""
        halves, between = list[_Front](), inner
        if len(inner) > _LEAF:
            parts, sides, between = min((self._cut(elements, inner, axis) for axis in range(3)), key=_width)
            remaining = [np.setdiff1d(side, between) for side in sides]
            halves = [self.eliminate(*half) for half in zip(parts, remaining, strict=True) if len(half[1])]
        beside = self.cells[elements[np.isin(self.cells[elements], between).any(axis=1)]].ravel()
        touched = np.unique(np.concatenate([beside, *(half.nodes for half in halves)]))
        around = np.setdiff1d(touched[~self.fixed[touched]], inner, assume_unique=True)
        own, side = self.entries(between, between), self.entries(around, between)
        update = np.zeros((3 * len(around),) * 2)
        for half in halves:
            inside, outside = (_shared(half.nodes, nodes) for nodes in (between, around))
            own[np.ix_(inside.place, inside.place)] += half.update[np.ix_(inside.part, inside.part)]
            side[np.ix_(outside.place, inside.place)] += half.update[np.ix_(outside.part, inside.part)]
            update[np.ix_(outside.place, outside.place)] += half.update[np.ix_(outside.part, outside.part)]
        root = cholesky(own, lower=True, check_finite=False)
        taken = solve_triangular(root, side.T, lower=True, check_finite=False)
        # One triangle, in place: NumPy's product takes twice as long, to mirror entry by entry.
        update = dsyrk(-1.0, taken, beta=1.0, c=update.T, trans=1, overwrite_c=1).T
        _mirror(update)
        return _Front(around, update)

    def entries(self, rows: Ints, columns: Ints) -> Floats:
        """The stiffness (3 R, 3 C) between nodes (R,) and (C,)."""
        across = degrees_of_freedom(columns)
        self.column[across] = np.arange(len(across))
        part = sp.coo_array(self.stiffness[degrees_of_freedom(rows)])
        place = self.column[part.col]
        self.column[across] = -1
        dense, used = np.zeros((3 * len(rows), len(across))), place >= 0
        dense[part.row[used], place[used]] = part.data[used]
        return dense

    def _cut(self, elements: Ints, inner: Ints, axis: int) -> _Cut:
        """Cuts elements (M,) into halves along an axis."""
        along = self.centre[elements, axis]
        low = along <= np.median(along)
        parts = elements[low], elements[~low]
        below, above = (np.intersect1d(inner, self.cells[part]) for part in parts)
        return parts, (below, above), np.intersect1d(below, above)


_Cut = tuple[tuple[Ints, Ints], tuple[Ints, Ints], Ints]
"""Elements of both halves; those nodes to eliminate that each touches; the nodes that both touch."""


@dataclass(frozen=True, eq=False)
class _Shared:
    """Degrees of freedom that two lists of nodes have in common, in one order."""

    part: Ints  # in the first
    place: Ints  # in the second


def _shared(nodes: Ints, others: Ints) -> _Shared:
    _, part, place = np.intersect1d(nodes, others, assume_unique=True, return_indices=True)
    return _Shared(degrees_of_freedom(part), degrees_of_freedom(place))


def _mirror(matrix: Floats) -> None:
    """Copies the lower triangle of a matrix to its upper one, in tiles that stay in the processor's cache."""
    for low in range(0, len(matrix), _TILE):
        high = low + _TILE
        tile = matrix[low:high, low:high]
        tile[:] = np.tril(tile) + np.tril(tile, -1).T
        for row in range(high, len(matrix), _TILE):
            matrix[low:high, row : row + _TILE] = matrix[row : row + _TILE, low:high].T


def _width(cut: _Cut) -> int:
    return len(cut[2])


def degrees_of_freedom(nodes: Ints) -> Ints:
    """Degrees of freedom (3 n,) of nodes (n,)."""
    return np.asarray((3 * nodes[:, None] + np.arange(3)).ravel())
