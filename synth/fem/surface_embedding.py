"""The fine surface on the volume mesh: it rides on the nearest place of it, and its loads go back there.

What stands out of the mesh (vessels, or the gap between a smooth surface and flat faces) is carried by a
rigid motion: the displacement u(p) of the nearest place p, and the rotation there for the rest of the way,

    u(x) = u(p) + w(p) x (x - p),    w = 1/2 curl u.

The whole gradient would carry strain as well, and its transpose would turn every force out there into a pair
of opposed forces on one element, without bound as elements get smaller.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from synth.fem.mesh.element import bary_slope, shape, shape_slope
from synth.fem.mesh.tetrahedra import Tets, boundary
from synth.system.jit import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Embedding:
    """V points of a surface on a volume of N nodes. `gather` is the transpose of `move`: work is kept, and
    since `move` holds every rigid motion, so are force and moment."""

    value: sp.csr_array
    """(V, N) shape functions at the nearest places."""
    corner: sp.csr_array
    """(V, 4 K) where the nearest places are, of the 4 corners of K tetrahedra: the gradient is even there."""
    spin: sp.csr_array
    """(12 K, 3 N) half the displacement's curl at those corners."""
    arm: Floats
    """(V, 3) mm from the nearest place."""

    def move(self, u: Floats) -> Floats:
        """Displacement (V, 3, ...) mm of the points, from the nodes' (N, 3, ...) mm."""
        moved = (self.value @ u.reshape(len(u), -1)).reshape(-1, *u.shape[1:])
        if self.corner.shape[1] == 0:
            return np.asarray(moved)
        spin = self.spin @ u.reshape(3 * len(u), -1)
        turned = self.corner @ spin.reshape(self.corner.shape[1], -1)
        return np.asarray(moved + _cross(turned.reshape(moved.shape), self._arm(moved)))

    def gather(self, force: Floats) -> Floats:
        """Nodal forces (N, 3, ...) mN, from those at the points, (V, 3, ...) mN."""
        flat = force.reshape(len(force), -1)
        nodal = (self.value.T @ flat).reshape(-1, *force.shape[1:])
        if self.corner.shape[1] == 0:
            return np.asarray(nodal)
        moment = _cross(self._arm(force), force).reshape(flat.shape)
        couple = self.spin.T @ (self.corner.T @ moment).reshape(self.spin.shape[0], -1)
        return np.asarray(nodal + couple.reshape(nodal.shape))

    def _arm(self, like: Floats) -> Floats:
        return self.arm.reshape(*self.arm.shape, *(1,) * (like.ndim - 2))


def embed(tets: Tets, vertices: Floats) -> Embedding:
    """Puts surface vertices (V, 3) mm, inside a volume or a little outside, where they ride on it."""
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
    arm = vertices - np.einsum("vc,vcd->vd", bary, corner[owner])
    rows = np.repeat(np.arange(len(vertices)), tets.cells.shape[1])
    size = (len(vertices), len(tets.points))
    value = sp.coo_array((shape(bary, tets.order).ravel(), (rows, tets.cells[owner].ravel())), shape=size)
    outside = np.flatnonzero(np.abs(arm).max(axis=1) > 1e-9)
    used, place = np.unique(owner[outside], return_inverse=True)
    columns = 4 * place[:, None] + np.arange(4)
    where = sp.coo_array(
        (bary[outside].ravel(), (np.repeat(outside, 4), columns.ravel())),
        shape=(len(vertices), 4 * len(used)),
    )
    return Embedding(value.tocsr(), where.tocsr(), _half_curl(tets, used, slope[used]), arm)


def _half_curl(tets: Tets, used: Ints, slope: Floats) -> sp.csr_array:
    """Half the curl at the corners of K tetrahedra, (12 K, 3 N) 1/mm; `slope` (K, 4, 3) of barycentrics."""
    gradient = np.einsum("cnb,kbd->kcnd", shape_slope(np.eye(4), tets.order), slope)  # (K, 4, n, 3)
    nodes = np.broadcast_to(tets.cells[used][:, None, :], gradient.shape[:3])
    at = np.broadcast_to(np.arange(4 * len(used)).reshape(-1, 4, 1), gradient.shape[:3])
    half = [(i, j, k, 0.5) for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
    half += [(i, k, j, -0.5) for i, j, k, _ in half]  # curl_i = d_j u_k - d_k u_j
    rows = np.concatenate([(3 * at + i).ravel() for i, _, _, _ in half])
    columns = np.concatenate([(3 * nodes + k).ravel() for _, _, k, _ in half])
    values = np.concatenate([(sign * gradient[..., j]).ravel() for _, j, _, sign in half])
    size = (12 * len(used), 3 * len(tets.points))
    return sp.coo_array((values, (rows, columns)), shape=size).tocsr()


def _cross(a: Floats, b: Floats) -> Floats:
    """Of vectors along axis 1."""
    return np.stack([a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)


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
