"""Motion and load carried over from one surface to another: from an engine's nodes to a scene's vertices.

A vertex x belongs to a point p of the nearest triangle of the engine. It moves with p, and turns with it:

    u(x) = u(p) + (R(p) - 1) (x - p).

Position and displacement are quadratic on a triangle. Their value in the middle of an edge follows from
values and gradients g at its ends, u_ij = (u_i + u_j) / 2 + (g_i - g_j) . (x_j - x_i) / 8 (Hermite): flat
facets would have kinks at nodes, which a picture shows. R is the rotation of the triangles around a node,
interpolated. Rigid motion is reproduced exactly.

A nodal force is shared among the vertices of the node's triangles in proportion to their area, so each force
keeps its size and direction; its place moves by less than a triangle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from synth.arrays import Floats, Ints
from synth.fem.surface_embedding import find_nearest, sparse_rows, vertex_area
from synth.geometry.triangles import Shape

_TILES = 12  # along the longer side of a scene, in which nearest triangles are searched separately


@dataclass(frozen=True, eq=False)
class Transfer:
    """V vertices of a scene on the surface of an engine's N nodes; made by `attach`."""

    motion: sp.csr_array  # (V, N) weights of the nodes' displacement
    corner: sp.csr_array  # (V, N) barycentrics of the nearest points
    load: sp.csr_array  # (V, N) share of each node's force that a vertex bears
    points: Floats  # (N, 3) mm of the nodes at rest
    faces: Ints  # (F, 3) the triangles that vertices lie on, and their neighbours
    arm: Floats  # (V, 3) mm from the nearest points

    def move(self, u: Floats) -> Floats:
        """Displacement (V, 3) mm of the vertices, from the nodes' (N, 3) mm."""
        rotations = _find_rotations(self.points, self.points + u, self.faces).reshape(len(u), 9)
        vertex_rotations = (self.corner @ rotations).reshape(-1, 3, 3)
        return np.asarray(self.motion @ u + np.einsum("vij,vj->vi", vertex_rotations, self.arm) - self.arm)

    def bear(self, force: Floats) -> Floats:
        """Forces (V, 3) on the vertices, from nodal forces (N, 3); those of nodes elsewhere are left out."""
        return np.asarray(self.load @ force)


def attach(points: Floats, faces: Ints, scene: Shape) -> Transfer:
    """Attaches the vertices of a scene to the nearest triangles (F, 3) of points (N, 3) mm."""
    vertices = np.ascontiguousarray(scene.vertices)
    face, bary = _find_nearest(points, faces, vertices)
    nodes = faces[face]
    corner = sparse_rows(bary, nodes, len(points))
    close_faces = faces[np.isin(faces, nodes).any(axis=1)]
    motion = sp.csr_array(corner + _bend(points, close_faces, nodes, bary))
    arm = vertices - motion @ points  # from the curved triangles, so that rigid motion stays exact
    area = vertex_area(*scene)
    share = sp.csr_array(corner.multiply(area[:, None]))
    node_area = np.asarray(share.sum(axis=0)).ravel()
    # Nodes between the vertices, on triangles without any, are borne by the nearest vertex.
    empty_nodes = np.flatnonzero(node_area == 0)
    distance, indices = cKDTree(vertices).query(
        points[empty_nodes], distance_upper_bound=2 * float(np.sqrt(area.max()))
    )
    is_close = np.isfinite(distance)
    remainder = sp.csr_array(
        (np.ones(is_close.sum()), (indices[is_close], empty_nodes[is_close])), shape=share.shape
    )
    scale = np.divide(1.0, node_area, out=np.zeros_like(node_area), where=node_area > 0)
    load = sp.csr_array(share.multiply(scale[None, :]) + remainder)
    return Transfer(motion, corner, load, points, close_faces, arm)


def _find_nearest(points: Floats, faces: Ints, vertices: Floats) -> tuple[Ints, Floats]:
    """Nearest face (V,) of each vertex and the barycentrics (V, 3) there; tile by tile, among near ones."""
    distance = cKDTree(points[np.unique(faces)]).query(vertices)[0]
    corner = np.ascontiguousarray(points[faces])
    low, high = corner.min(axis=1), corner.max(axis=1)
    index = np.floor((vertices - vertices.min(axis=0)) / np.ptp(vertices, axis=0).max() * _TILES)
    tile = np.unique(index, axis=0, return_inverse=True)[1].ravel()
    owner, bary = np.zeros(len(vertices), np.int64), np.zeros((len(vertices), 3))
    for members in np.split(np.argsort(tile, kind="stable"), np.cumsum(np.bincount(tile))[:-1]):
        tile_vertices, reach = vertices[members], distance[members].max()
        overlap = (high >= tile_vertices.min(axis=0) - reach) & (low <= tile_vertices.max(axis=0) + reach)
        close_faces = np.flatnonzero(overlap.all(axis=1))
        nearest_face, bary[members] = find_nearest(corner[close_faces], tile_vertices)
        owner[members] = close_faces[nearest_face]
    return owner, bary


def _bend(points: Floats, close_faces: Ints, nodes: Ints, bary: Floats) -> sp.csr_array:
    """(V, N) what the quadratic motion adds to the linear one: 4 b_i b_j (g_i - g_j) . (x_j - x_i) / 8."""
    edge = points[np.roll(nodes, -1, axis=1)] - points[nodes]  # (V, 3, 3) from corner i to j, the next one
    part = 0.5 * (bary * np.roll(bary, -1, axis=1))[..., None] * edge
    part -= np.roll(part, 1, axis=1)  # that of g_j
    x, y, z = (
        sparse_rows(part[..., d], nodes, len(points)) @ gradient
        for d, gradient in enumerate(_gradient(points, close_faces))
    )
    return sp.csr_array(x + y + z)


def _gradient(points: Floats, faces: Ints) -> list[sp.csr_array]:
    """Three (N, N): x, y, z of the gradient along the surface at nodes, the area's mean over their faces."""
    corner = points[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])  # twice the area long
    double = np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    area = np.bincount(faces.ravel(), np.repeat(double, 3), len(points))
    share = double[:, None] / np.maximum(area, 1e-300)[faces]  # (F, 3) of a face in the mean at its corners
    side = np.roll(corner, 1, axis=1) - np.roll(corner, -1, axis=1)  # each opposite its corner
    slope = np.cross(normal[:, None], side) / (double**2)[:, None, None]  # (F, k, 3) of the k-th barycentric
    place = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel()
    values = share[:, :, None, None] * slope[:, None]  # (F, node, k, 3)
    size = (len(points), len(points))
    return [sp.coo_array((values[..., d].ravel(), place), shape=size).tocsr() for d in range(3)]


def _find_rotations(rest: Floats, deformed: Floats, faces: Ints) -> Floats:
    """Rotations (N, 3, 3) at nodes: nearest to the mean gradient of motion in the faces around them."""

    def frames(points: Floats) -> Floats:
        a, b, c = (points[faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        size = np.sqrt(np.maximum(np.linalg.norm(normal, axis=1), 1e-300))
        return np.stack([b - a, c - a, normal / size[:, None]], axis=2)

    gradient = frames(deformed) @ np.linalg.inv(frames(rest))
    gradient_sum = np.zeros((len(rest), 3, 3))
    used = np.unique(faces)
    for k in range(3):
        np.add.at(gradient_sum, faces[:, k], gradient)
    left, _, right = np.linalg.svd(gradient_sum[used])
    flip = np.linalg.det(left @ right) < 0
    left[flip, :, 2] *= -1
    rotations = np.broadcast_to(np.eye(3), gradient_sum.shape).copy()
    rotations[used] = left @ right
    return rotations
