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


def condense(stiffness: sp.csr_array, points: Floats, cells: Ints, nodes: Ints, fixed: Mask) -> Floats:
    """The stiffness (3 K, 3 K) mN/mm at `nodes` (K,), in their order, with all others eliminated.

    Args:
        stiffness: (3 N, 3 N) mN/mm, symmetric, degrees of freedom node by node, between nodes of one element.
        points: (N, 3) mm; they only decide the order of elimination.
        cells: (M, n) nodes of the elements, corners first.
        nodes: indices of the kept ones, none of them fixed.
        fixed: (N,) nodes that cannot move.

    Raises:
        LinAlgError: the eliminated part is not positive definite, as nothing holds it.
    """
    interior = ~fixed
    interior[nodes] = False
    centre = points[cells[:, :4]].mean(axis=1)
    mesh = _Mesh(sp.csr_array(stiffness), cells, centre, fixed, np.full(3 * len(points), -1, np.int64))
    front = mesh.eliminate(np.arange(len(cells)), np.flatnonzero(interior))
    schur = mesh.entries(nodes, nodes)
    order = np.argsort(nodes)
    place = degrees_of_freedom(order[np.searchsorted(nodes, front.nodes, sorter=order)])
    schur[np.ix_(place, place)] += front.update
    return schur


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

    def eliminate(self, elements: Ints, interior: Ints) -> _Front:
        """Eliminates the nodes `interior`, which only these elements touch: by halves, then those between."""
        fronts, separator = list[_Front](), interior
        if len(interior) > _LEAF:
            parts, sides, separator = min(
                (self._cut(elements, interior, axis) for axis in range(3)), key=_width
            )
            remaining = [np.setdiff1d(side, separator) for side in sides]
            fronts = [self.eliminate(*half) for half in zip(parts, remaining, strict=True) if len(half[1])]
        adjacent_nodes = self.cells[elements[np.isin(self.cells[elements], separator).any(axis=1)]].ravel()
        touched = np.unique(np.concatenate([adjacent_nodes, *(front.nodes for front in fronts)]))
        boundary = np.setdiff1d(touched[~self.fixed[touched]], interior, assume_unique=True)
        pivot, coupling = self.entries(separator, separator), self.entries(boundary, separator)
        update = np.zeros((3 * len(boundary),) * 2)
        for front in fronts:
            inner, outer = (_intersect(front.nodes, nodes) for nodes in (separator, boundary))
            pivot[np.ix_(inner.place, inner.place)] += front.update[np.ix_(inner.part, inner.part)]
            coupling[np.ix_(outer.place, inner.place)] += front.update[np.ix_(outer.part, inner.part)]
            update[np.ix_(outer.place, outer.place)] += front.update[np.ix_(outer.part, outer.part)]
        pivot_factor = cholesky(pivot, lower=True, check_finite=False)
        coupling_factor = solve_triangular(pivot_factor, coupling.T, lower=True, check_finite=False)
        # One triangle, in place: NumPy's product takes twice as long, to mirror entry by entry.
        update = dsyrk(-1.0, coupling_factor, beta=1.0, c=update.T, trans=1, overwrite_c=1).T
        _mirror(update)
        return _Front(boundary, update)

    def entries(self, rows: Ints, columns: Ints) -> Floats:
        """The stiffness (3 R, 3 C) between nodes (R,) and (C,)."""
        dofs = degrees_of_freedom(columns)
        self.column[dofs] = np.arange(len(dofs))
        part = sp.coo_array(self.stiffness[degrees_of_freedom(rows)])
        place = self.column[part.col]
        self.column[dofs] = -1
        dense, mask = np.zeros((3 * len(rows), len(dofs))), place >= 0
        dense[part.row[mask], place[mask]] = part.data[mask]
        return dense

    def _cut(self, elements: Ints, interior: Ints, axis: int) -> _Cut:
        """Cuts elements (M,) into halves along an axis."""
        coordinate = self.centre[elements, axis]
        low = coordinate <= np.median(coordinate)
        parts = elements[low], elements[~low]
        lower, upper = (np.intersect1d(interior, self.cells[part]) for part in parts)
        return parts, (lower, upper), np.intersect1d(lower, upper)


_Cut = tuple[tuple[Ints, Ints], tuple[Ints, Ints], Ints]
"""Elements of both halves; those nodes to eliminate that each touches; the nodes that both touch."""


@dataclass(frozen=True, eq=False)
class _Overlap:
    """Degrees of freedom that two lists of nodes have in common, in one order."""

    part: Ints  # in the first
    place: Ints  # in the second


def _intersect(nodes: Ints, others: Ints) -> _Overlap:
    _, part, place = np.intersect1d(nodes, others, assume_unique=True, return_indices=True)
    return _Overlap(degrees_of_freedom(part), degrees_of_freedom(place))


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
