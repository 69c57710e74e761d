"""Volume integrals: nodal displacement to strain, stress to nodal force, and the stiffness."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from synth.arrays import Floats, Indices
from synth.fem.mesh.element import Quadrature, scatter_blocks
from synth.system.jit import argument_types, compiled


@argument_types("i4[:,::1], f8[:,:,:,::1], f8[:,::1], f8[:,:,::1]")
@compiled
def gradient(cells: Indices, slope: Floats, u: Floats, out: Floats) -> None:
    """Displacement gradient at every quadrature point: writes `out[p, i, j]` = du_i/dx_j, (M * Q, 3, 3).

    `cells`: (M, n) nodes; `slope`: (M, Q, n, 3) 1/mm; `u`: (N, 3) mm.
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


@argument_types("i4[:,::1], f8[:,:,:,::1], f8[:,::1], f8[:,:,::1], f8[:,::1]")
@compiled
def divergence(cells: Indices, slope: Floats, weight: Floats, stress: Floats, out: Floats) -> None:
    """Nodal forces `out` (N, 3) mN that balance a stress (M * Q, 3, 3) kPa: the transpose of `gradient`.

    `cells`, `slope`: as there; `weight`: (M, Q) mm^3.
    """
    elements, points, nodes, _ = slope.shape
    out[:] = 0.0
    for e in range(elements):
        for q in range(points):
            p = stress[e * points + q]
            w = weight[e, q]
            for n in range(nodes):
                a, b, c = w * slope[e, q, n, 0], w * slope[e, q, n, 1], w * slope[e, q, n, 2]
                node = cells[e, n]
                for i in range(3):
                    out[node, i] += p[i, 0] * a + p[i, 1] * b + p[i, 2] * c


def stiffness(mesh: Quadrature, moduli: Floats, swelling_gradient: Floats | None = None) -> sp.csr_array:
    """Tangent stiffness (3N, 3N) mN/mm of a mesh, degrees of freedom node by node.

    `moduli` (M * Q, 3, 3, 3, 3) kPa: dP/dF at every point; or (1, 3, 3, 3, 3), one for all.
    `swelling_gradient` (M, n, 3) sqrt(mN/mm): its outer products with itself are added to the elements'
    stiffness.
    """
    (elements, n), points = mesh.cells.shape, mesh.weight.shape[1]
    # By n, j -> n, (i, k, m); then, with points and m as one axis, by n, i, k -> o.
    tangent = np.moveaxis(moduli, 2, 1).reshape(-1, 1 if len(moduli) == 1 else points, 3, 27)
    half = (mesh.weight[:, :, None, None] * mesh.slope) @ tangent  # (M, Q, n, 27)
    half = half.reshape(elements, points, n * 9, 3).swapaxes(1, 2).reshape(elements, n * 9, points * 3)
    gradients = mesh.slope.swapaxes(2, 3).reshape(elements, points * 3, n)
    local = (half @ gradients).reshape(elements, n, 3, 3, n).swapaxes(3, 4)
    if swelling_gradient is not None:
        local += swelling_gradient[:, :, :, None, None] * swelling_gradient[:, None, None]
    return scatter_blocks(local, mesh.cells, mesh.nodes)
