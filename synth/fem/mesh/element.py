"""Quadratic tetrahedra: shape functions and quadrature for the volume integrals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from synth.arrays import Array, Floats, Indices, Ints
from synth.fem.mesh.refine import EDGES

_A, _B = (5 + 3 * np.sqrt(5)) / 20, (5 - np.sqrt(5)) / 20
TET_POINTS = np.full((4, 4), _B) + (_A - _B) * np.eye(4)
"""Barycentric quadrature points, all of weight 1/4, of degree 2: exact for the rest stiffness of straight
tetrahedra (Keast, Comput. Meth. Appl. Mech. Eng. 55, 1986)."""

_C, _D = 0.445948490915965, 0.091576213509771
TRI_POINTS = np.array(
    [[1 - 2 * c if i == j else c for i in range(3)] for c in (_C, _D) for j in range(3)], np.float64
)
"""(6, 3) barycentric points of degree 4 on a triangle (Dunavant, Int. J. Numer. Meth. Eng. 21, 1985)."""
TRI_WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)
"""(6,) their weights, summing to 1."""


def _ends(bary: Floats) -> Ints:
    """First and second corner (2, ...) of each side of a tetrahedron or, of three coordinates, a face."""
    return np.asarray(EDGES[(bary.shape[-1] > EDGES).all(axis=1)].T)


def shape(bary: Floats) -> Floats:
    """Shape functions of a tetrahedron, (..., 10) at (..., 4) barycentric coordinates, or of a face, (..., 6)
    at (..., 3): of the corners, then of the midsides in the order of `EDGES`."""
    first, second = _ends(bary)
    return np.concatenate([bary * (2 * bary - 1), 4 * bary[..., first] * bary[..., second]], axis=-1)


def shape_slope(bary: Floats) -> Floats:
    """Derivatives (..., 10, 3) or (..., 6, 2) of `shape` by all barycentric coordinates but the first.

    The first is 1 less the others.
    """
    identity, (first, second) = np.eye(bary.shape[-1]), _ends(bary)
    sides = 4 * (bary[..., first, None] * identity[second] + bary[..., second, None] * identity[first])
    slope = np.concatenate([identity * (4 * bary - 1)[..., None, :], sides], axis=-2)
    return np.asarray(slope[..., 1:] - slope[..., :1])


def scatter(local: Floats, nodes: Array, size: int) -> sp.csr_array:
    """Sums element matrices (E, n, n) over their nodes (E, n) into (size, size)."""
    n = nodes.shape[1]
    rows, columns = np.repeat(nodes, n, axis=1).ravel(), np.tile(nodes, (1, n)).ravel()
    return sp.coo_array((local.ravel(), (rows, columns)), shape=(size, size)).tocsr()


def scatter_blocks(local: Floats, cells: Array, nodes: int) -> sp.csr_array:
    """Sums element matrices (E, n, 3, n, 3) over their nodes (E, n) into (3 nodes, 3 nodes).

    As `scatter` over all degrees of freedom, but a ninth of the entries are sorted.
    """
    pair = (cells[:, :, None].astype(np.int64) * nodes + cells[:, None, :]).ravel()
    unique_pairs, inverse = np.unique(pair, return_inverse=True)
    indptr = np.arange(len(pair) + 1)
    sums = sp.csc_array((np.ones(len(pair)), inverse, indptr), shape=(len(unique_pairs), len(pair)))
    blocks = (sums @ local.swapaxes(2, 3).reshape(-1, 9)).reshape(-1, 3, 3)
    first = np.append(0, np.cumsum(np.bincount(unique_pairs // nodes, minlength=nodes))).astype(np.int32)
    columns = (unique_pairs % nodes).astype(np.int32)
    size = 3 * nodes
    matrix: sp.csr_array = sp.bsr_array((blocks, columns, first), shape=(size, size)).tocsr()
    return matrix


def bary_slope(corners: Floats) -> tuple[Floats, Floats]:
    """Gradients (M, 4, 3) 1/mm of the barycentric coordinates of straight tetrahedra (M, 4, 3) mm, and their
    volumes (M,) mm^3, negative where a tetrahedron is inside out."""
    sides = corners[:, 1:] - corners[:, :1]
    inverse = np.linalg.inv(sides)  # rows: directions in space; columns: barycentrics 1..3
    slope = np.empty_like(corners)
    slope[:, 1:] = inverse.transpose(0, 2, 1)
    slope[:, 0] = -slope[:, 1:].sum(axis=1)
    return slope, np.linalg.det(sides) / 6


def quality(corners: Floats) -> Floats:
    """Mean ratio of tetrahedra (M, 4, 3): 1 is regular, 0 flat, below 0 inside out.

    Liu & Joe, BIT 34, 1994.
    """
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    squares = ((corners[:, EDGES[:, 0]] - corners[:, EDGES[:, 1]]) ** 2).sum(axis=(1, 2))
    return np.asarray(12 * np.sign(volume) * (3 * np.abs(volume)) ** (2 / 3) / squares)


@dataclass(frozen=True)
class Quadrature:
    """A mesh's quadrature: M elements with Q points and n nodes each."""

    cells: Indices  # (M, n) nodes
    slope: Floats  # (M, Q, n, 3) gradients of the shape functions at the points, 1/mm
    weight: Floats  # (M, Q) mm^3
    nodes: int  # N, number of nodes


def quadrature(points: Floats, cells: Ints, bary: Floats = TET_POINTS) -> Quadrature:
    """The quadrature of nodes (N, 3) mm and cells (M, 10), whose sides may be curved, at (Q, 4) barycentric
    points of equal weight in every element."""
    gradient, determinant = gradients(points[cells], bary)
    weight = determinant / (6 * len(bary))
    return Quadrature(cells.astype(np.int32), np.ascontiguousarray(gradient), weight, len(points))


def gradients(nodes: Floats, bary: Floats) -> tuple[Floats, Floats]:
    """Gradients (M, Q, 10, 3) 1/mm of the shape functions of isoparametric elements (M, 10, 3) mm at (Q, 4)
    barycentric points, and (M, Q) mm^3: 6 times the volume of a straight element, negative inside out."""
    local, jacobian = _mapping(nodes, bary)
    return np.einsum("qnk,mqdk->mqnd", local, np.linalg.inv(jacobian)), np.linalg.det(jacobian)


def _mapping(nodes: Floats, bary: Floats) -> tuple[Floats, Floats]:
    """Derivatives by three local coordinates: of shape functions (Q, 10, 3) and of position (M, Q, 3, 3)."""
    local = shape_slope(bary)
    flat = np.ascontiguousarray(local.transpose(0, 2, 1).reshape(-1, local.shape[1]))
    return local, (flat @ nodes).reshape(len(nodes), len(bary), 3, 3)


def jacobians(points: Floats, cells: Ints) -> Floats:
    """Jacobian at the corners and quadrature points over that of the straight element, (M, 4 + Q)."""
    determinant = np.linalg.det(_mapping(points[cells], np.vstack([np.eye(4), TET_POINTS]))[1])
    straight = np.linalg.det(points[cells[:, 1:4]] - points[cells[:, :1]])
    return np.asarray(determinant / straight[:, None])
