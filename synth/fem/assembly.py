"""Volume integrals: nodal displacement to strain, stress to nodal force, and the stiffness at rest."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from synth.fem.element import Quadrature
from synth.fem.jit import compiled
from synth.fem.laws import lame

Floats = NDArray[np.float64]
Cells = NDArray[np.int32]


@compiled
def gradient(cells: Cells, slope: Floats, u: Floats, out: Floats) -> None:
    """Displacement gradient at every quadrature point, in place.

    Args:
        cells: (M, n) nodes.
        slope: (M, Q, n, 3) 1/mm.
        u: (N, 3) mm.
        out: (M * Q, 3, 3), overwritten; `out[p, i, j]` = du_i/dx_j.
    """
    elements, points, nodes, _ = slope.shape
    for e in range(elements):
        for q in range(points):
            g = out[e * points + q]
            for i in range(3):
                a, b, c = 0.0, 0.0, 0.0
                for n in range(nodes):
                    v = u[cells[e, n], i]
                    a += v * slope[e, q, n, 0]
                    b += v * slope[e, q, n, 1]
                    c += v * slope[e, q, n, 2]
                g[i, 0], g[i, 1], g[i, 2] = a, b, c


@compiled
def divergence(cells: Cells, slope: Floats, weight: Floats, stress: Floats, out: Floats) -> None:
    """Nodal forces that balance a stress, in place: the transpose of `gradient`.

    Args:
        cells, slope: as in `gradient`.
        weight: (M, Q) mm^3.
        stress: (M * Q, 3, 3) kPa.
        out: (N, 3) mN, overwritten.
    """
    elements, points, nodes, _ = slope.shape
    out[:] = 0.0
    for e in range(elements):
        for q in range(points):
            p = stress[e * points + q]
            w = weight[e, q]
            for n in range(nodes):
                a, b, c = w * slope[e, q, n, 0], w * slope[e, q, n, 1], w * slope[e, q, n, 2]
                at = cells[e, n]
                for i in range(3):
                    out[at, i] += p[i, 0] * a + p[i, 1] * b + p[i, 2] * c


def stiffness(mesh: Quadrature, young: float, poisson: float) -> sp.csr_array:
    """Stiffness of Hooke's law, the tangent of every law at rest.

    Args:
        mesh: the elements.
        young: kPa.
        poisson: below 0.5.

    Returns:
        (3N, 3N) mN/mm, degrees of freedom node by node.
    """
    mu, lam = lame(young, poisson)
    d, w = mesh.slope, mesh.weight
    outer = np.einsum("mq,mqai,mqbj->maibj", w, d, d, optimize=True)
    local = lam * outer + mu * outer.transpose(0, 1, 4, 3, 2)
    dot = np.einsum("maibi->mab", outer)
    for i in range(3):
        local[:, :, i, :, i] += mu * dot
    n = mesh.cells.shape[1]
    dof = (3 * mesh.cells[:, :, None] + np.arange(3)).reshape(len(mesh.cells), 3 * n)
    rows, cols = np.repeat(dof, 3 * n, axis=1).ravel(), np.tile(dof, (1, 3 * n)).ravel()
    return sp.coo_array((local.ravel(), (rows, cols)), shape=(3 * mesh.nodes,) * 2).tocsr()
