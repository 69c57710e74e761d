"""The fine surface attached to the volume mesh: vertices follow its nearest point and load it.

A vertex x outside the mesh (on a vessel, or in the gap between a smooth surface and flat faces) moves rigidly
with the nearest point p of the mesh:

    u(x) = u(p) + w(p) x (x - p),    w = 1/2 curl u.

The full gradient would transfer strain as well, and its transpose would turn a force at x into a pair of
opposed forces on one element, without bound as elements get smaller.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from synth.arrays import Floats, Ints
from synth.fem.mesh.element import gradients, shape
from synth.fem.mesh.tetrahedra import FACES, Tets, outer_faces
from synth.system.jit import argument_types, as_constant, compiled, inlined

_EVEN_MM = 2.0  # length over which rotation is averaged


@dataclass(frozen=True, eq=False)
class Embedding:
    """V points of a surface on a volume of N nodes. `gather` is the transpose of `move`, so work is
    conserved, and since `move` reproduces every rigid motion, so are force and moment."""

    value: sp.csr_array  # (V, N) shape functions at the nearest points of the mesh
    corner: sp.csr_array  # (V, K) barycentrics of the nearest points between the K corners of outer faces
    mean: Floats  # (K, K) filter that averages the rotation at those corners
    spin: sp.csr_array  # (3 K, 3 N) half the displacement's curl at those corners
    arm: Floats  # (V, 3) mm from the nearest point

    def move(self, u: Floats) -> Floats:
        """Displacement (V, 3, ...) mm of the points, from the nodes' (N, 3, ...) mm."""
        motion = (self.value @ u.reshape(len(u), -1)).reshape(-1, *u.shape[1:])
        spin = self.spin @ u.reshape(3 * len(u), -1)
        rotation = self.corner @ (self.mean @ spin.reshape(len(self.mean), -1))
        return np.asarray(motion + np.cross(rotation.reshape(motion.shape), self._arm(motion), axis=1))

    def gather(self, force: Floats) -> Floats:
        """Nodal forces (N, 3, ...) mN, from those at the points, (V, 3, ...) mN."""
        rows = np.flatnonzero(force.reshape(len(force), -1).any(axis=1))  # few of them, as a rule
        width = int(np.prod(force.shape[1:]))
        flat = force[rows].reshape(len(rows), width)
        moment = np.cross(self._arm(force)[rows], force[rows], axis=1).reshape(flat.shape)
        nodal = (self.value[rows].T @ flat).reshape(-1, *force.shape[1:])
        couple = self.mean.T @ (self.corner[rows].T @ moment)
        couple = self.spin.T @ couple.reshape(self.spin.shape[0], width // 3)
        return np.asarray(nodal + couple.reshape(nodal.shape))

    def _arm(self, like: Floats) -> Floats:
        return self.arm.reshape(*self.arm.shape, *(1,) * (like.ndim - 2))


def embed(tets: Tets, vertices: Floats) -> Embedding:
    """Attaches the vertices (V, 3) mm of a surface to the nearest outer faces of a volume."""
    owner, apex = outer_faces(tets.cells)
    faces = FACES[apex]
    nodes = tets.cells[owner[:, None], faces]
    corner = np.ascontiguousarray(tets.points[nodes])
    face, on_face = find_nearest(corner, as_constant(np.ascontiguousarray(vertices)))
    bary = np.zeros((len(vertices), 4))
    np.put_along_axis(bary, faces[face], on_face, axis=1)
    value = sparse_rows(shape(bary), tets.cells[owner[face]], len(tets.points))
    used_faces = np.unique(face)
    corners, local = np.unique(nodes[used_faces], return_inverse=True)
    local = local.reshape(-1, 3)
    mean, lumped = _averaging(tets.points[nodes[used_faces]], local, len(corners))
    return Embedding(
        value,
        sparse_rows(on_face, local[np.searchsorted(used_faces, face)], len(corners)),
        mean,
        _half_curl(tets, owner[used_faces], faces[used_faces], local, lumped),
        vertices - value @ tets.points,
    )


def sparse_rows(values: Floats, columns: Ints, width: int) -> sp.csr_array:
    """Rows (V, n) of values at columns, as (V, width)."""
    rows = np.repeat(np.arange(len(values)), values.shape[1])
    matrix = sp.coo_array((values.ravel(), (rows, columns.ravel())), shape=(len(values), width)).tocsr()
    matrix.eliminate_zeros()
    return matrix


def _averaging(corner: Floats, local: Ints, count: int) -> tuple[Floats, Floats]:
    """A filter (K, K) that averages values at K corners of faces over `_EVEN_MM`, however small the faces,
    and each face's part (F, 3) in the area of its corners.

    Helmholtz' filter (1 - l^2 Laplacian)^-1 (Lazarov & Sigmund, Int. J. Numer. Meth. Eng. 86, 2011): rows sum
    to 1. `corner`: (F, 3, 3) mm; `local`: (F, 3) their indices among the K corners.
    """
    sides = np.roll(corner, -1, axis=1) - np.roll(corner, 1, axis=1)  # each opposite its corner
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    stiff = np.einsum("fid,fjd->fij", sides, sides) / (4 * area[:, None, None])
    matrix = np.zeros((count, count))
    np.add.at(matrix, (local[:, :, None], local[:, None, :]), _EVEN_MM**2 * stiff)
    mass = np.bincount(local.ravel(), np.repeat(area / 3, 3), count)
    matrix[np.diag_indices(count)] += mass
    return np.asarray(np.linalg.inv(matrix) * mass), (area / 3)[:, None] / mass[local]


def _half_curl(tets: Tets, owner: Ints, faces: Ints, local: Ints, share: Floats) -> sp.csr_array:
    """Half the curl at K corners of faces, (3 K, 3 N) 1/mm: the mean over the faces' elements there.

    For each face (F,) `owner` is its element; `faces` (F, 3) are its corners in the element, `local` (F, 3)
    among the K, and `share` (F, 3) the weight of the element in their means.
    """
    gradient = gradients(tets.points[tets.cells[owner]], np.eye(4))[0]  # (F, 4, n, 3)
    gradient = 0.5 * share[:, :, None, None] * np.take_along_axis(gradient, faces[:, :, None, None], axis=1)
    nodes = np.broadcast_to(tets.cells[owner][:, None, :], gradient.shape[:3])
    corners = np.broadcast_to(local[:, :, None], gradient.shape[:3])
    # curl_i = d_j u_k - d_k u_j
    parts = [(i, k, gradient[..., j]) for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
    parts += [(i, j, -gradient[..., k]) for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
    rows = np.concatenate([(3 * corners + i).ravel() for i, _, _ in parts])
    columns = np.concatenate([(3 * nodes + k).ravel() for _, k, _ in parts])
    values = np.concatenate([value.ravel() for _, _, value in parts])
    size = (3 * (int(local.max()) + 1), 3 * len(tets.points))
    return sp.coo_array((values, (rows, columns)), shape=size).tocsr()


def vertex_area(vertices: Floats, faces: NDArray[np.integer]) -> Floats:
    """A third of the area of the faces around each vertex, (V,) mm^2."""
    corner = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return np.bincount(faces.ravel(), np.repeat(area / 3, 3), len(vertices)).astype(np.float64)


@argument_types("f8[:,:,::1], Array(f8, 2, 'C', readonly=True)")
@compiled
def find_nearest(corner: Floats, vertices: Floats) -> tuple[Ints, Floats]:
    """For each vertex the nearest triangle of (F, 3, 3) mm, and the barycentrics of the nearest point."""
    count = len(corner)
    low, high = np.empty((count, 3)), np.empty((count, 3))
    for t in range(count):
        for d in range(3):
            low[t, d] = min(corner[t, 0, d], corner[t, 1, d], corner[t, 2, d])
            high[t, d] = max(corner[t, 0, d], corner[t, 1, d], corner[t, 2, d])
    owner = np.zeros(len(vertices), np.int64)
    bary = np.zeros((len(vertices), 3))
    trial = np.empty(3)
    last = 0
    for v in range(len(vertices)):
        x = vertices[v]
        best = np.inf
        for step in range(count + 1):
            t = last if step == 0 else step - 1  # neighbours in the list are mostly on one triangle
            box = 0.0
            for d in range(3):
                gap = max(low[t, d] - x[d], x[d] - high[t, d], 0.0)
                box += gap * gap
            if box >= best:
                continue
            distance = _on_triangle(corner[t, 0], corner[t, 1], corner[t, 2], x, trial)
            if distance < best:
                best = distance
                owner[v] = t
                for d in range(3):
                    bary[v, d] = trial[d]
        last = owner[v]
    return owner, bary


@inlined
def _on_triangle(a: Floats, b: Floats, c: Floats, x: Floats, w: Floats) -> float:
    """Squared distance of x from a triangle; `w` receives the nearest point's barycentrics.

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
