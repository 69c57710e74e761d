"""The fine surface on the volume mesh: it follows by a sparse matrix B, and its loads go back by B'."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from synth.fem.mesh.element import bary_slope, shape, shape_slope
from synth.fem.mesh.tetrahedra import Tets, boundary
from synth.system.jit import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def embedding(tets: Tets, vertices: Floats) -> sp.csr_array:
    """Matrix that carries nodal displacement to surface vertices.

    A vertex takes the value at the nearest place of the volume and, for the rest of the way, the gradient
    there: rows sum to 1 and linear fields come back exactly, inside and outside; B' keeps force and moment.

    Args:
        tets: the volume.
        vertices: (V, 3) mm; inside, or a little outside.

    Returns:
        (V, N).
    """
    outer = np.zeros(len(tets.points), bool)
    outer[boundary(tets.cells[:, :4], 1)] = True
    reach = vertices.min(axis=0), vertices.max(axis=0)
    corner = tets.points[tets.cells[:, :4]]
    margin = 0.25 * float((reach[1] - reach[0]).max()) + 1e-9
    near = ((corner.max(axis=1) >= reach[0] - margin) & (corner.min(axis=1) <= reach[1] + margin)).all(axis=1)
    chosen = np.flatnonzero(near) if near.any() else np.arange(len(corner))
    # Surface tetrahedra first: most vertices are in one, and the search ends early.
    chosen = chosen[np.argsort(~outer[tets.cells[chosen, :4]].any(axis=1), kind="stable")]
    slope, _ = bary_slope(corner)
    owner, bary = _nearest(
        np.ascontiguousarray(corner[chosen]), slope[chosen], np.ascontiguousarray(vertices)
    )
    owner = chosen[owner]
    place = np.einsum("vc,vcd->vd", bary, corner[owner])
    step = np.einsum("vcd,vd->vc", slope[owner], vertices - place)
    value = shape(bary, tets.order)
    if np.abs(step).max(initial=0) > 0:
        value = value + np.einsum("vnc,vc->vn", shape_slope(bary, tets.order), step)
    rows = np.repeat(np.arange(len(vertices)), tets.cells.shape[1])
    size = (len(vertices), len(tets.points))
    return sp.coo_array((value.ravel(), (rows, tets.cells[owner].ravel())), shape=size).tocsr()


def vertex_area(vertices: Floats, faces: NDArray[np.integer]) -> Floats:
    """A third of the area of the faces round each vertex, (V,) mm^2."""
    corner = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return np.bincount(faces.ravel(), np.repeat(area / 3, 3), len(vertices)).astype(np.float64)


@compiled
def _nearest(corner: Floats, slope: Floats, vertices: Floats) -> tuple[Ints, Floats]:
    """For each vertex the nearest tetrahedron and the barycentrics of the nearest place in it."""
    count = len(corner)
    low, high = np.empty((count, 3)), np.empty((count, 3))
    for t in range(count):
        for d in range(3):
            low[t, d] = min(corner[t, 0, d], corner[t, 1, d], corner[t, 2, d], corner[t, 3, d])
            high[t, d] = max(corner[t, 0, d], corner[t, 1, d], corner[t, 2, d], corner[t, 3, d])
    owner = np.zeros(len(vertices), np.int64)
    bary = np.zeros((len(vertices), 4))
    trial = np.empty(4)
    last = 0
    for v in range(len(vertices)):
        x = vertices[v]
        best = np.inf
        for step in range(count + 1):
            t = last if step == 0 else step - 1  # neighbours in the list are mostly in one tetrahedron
            box = 0.0
            for d in range(3):
                gap = max(low[t, d] - x[d], x[d] - high[t, d], 0.0)
                box += gap * gap
            if box >= best:
                continue
            distance = _place(corner[t], slope[t], x, trial)
            if distance < best:
                best = distance
                owner[v] = t
                bary[v] = trial
                if best == 0.0:
                    break
        last = owner[v]
    return owner, bary


@compiled
def _place(corner: Floats, slope: Floats, x: Floats, bary: Floats) -> float:
    """Squared distance of x from a tetrahedron; `bary` becomes the nearest place's."""
    inside = True
    bary[0] = 1.0
    for c in range(1, 4):
        b = 0.0
        for d in range(3):
            b += slope[c, d] * (x[d] - corner[0, d])
        bary[c] = b
        bary[0] -= b
        inside = inside and b >= 0.0
    if inside and bary[0] >= 0.0:
        return 0.0
    best = np.inf
    w = np.empty(3)
    result = np.zeros(4)
    for off in range(4):
        i, j, k = (off + 1) % 4, (off + 2) % 4, (off + 3) % 4
        distance = _on_triangle(corner[i], corner[j], corner[k], x, w)
        if distance < best:
            best = distance
            result[:] = 0.0
            result[i], result[j], result[k] = w[0], w[1], w[2]
    bary[:] = result
    return best


@compiled
def _on_triangle(a: Floats, b: Floats, c: Floats, x: Floats, w: Floats) -> float:
    """Squared distance of x from a triangle; `w` becomes the nearest place's barycentrics.

    By the regions of the corners, sides and face (Ericson, Real-Time Collision Detection, 5.1.5).
    """
    d1, d2, d3, d4, d5, d6 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for d in range(3):
        e, f = b[d] - a[d], c[d] - a[d]
        d1 += e * (x[d] - a[d])
        d2 += f * (x[d] - a[d])
        d3 += e * (x[d] - b[d])
        d4 += f * (x[d] - b[d])
        d5 += e * (x[d] - c[d])
        d6 += f * (x[d] - c[d])
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0 and d2 <= 0:
        w[0], w[1], w[2] = 1.0, 0.0, 0.0
    elif d3 >= 0 and d4 <= d3:
        w[0], w[1], w[2] = 0.0, 1.0, 0.0
    elif d6 >= 0 and d5 <= d6:
        w[0], w[1], w[2] = 0.0, 0.0, 1.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        s = d1 / (d1 - d3)
        w[0], w[1], w[2] = 1 - s, s, 0.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        s = d2 / (d2 - d6)
        w[0], w[1], w[2] = 1 - s, 0.0, s
    elif va <= 0 and d4 >= d3 and d5 >= d6:
        s = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        w[0], w[1], w[2] = 0.0, 1 - s, s
    else:
        total = va + vb + vc
        w[0], w[1], w[2] = va / total, vb / total, vc / total
    distance = 0.0
    for d in range(3):
        gap = w[0] * a[d] + w[1] * b[d] + w[2] * c[d] - x[d]
        distance += gap * gap
    return distance
