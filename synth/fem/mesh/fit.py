"""Moves the corners of a boundary so that its faces, rather than its corners, lie on the surface on average.

Least squares of the height between face and surface over all faces. A mesh with its corners on a convex body
loses volume; since constants are among the fitted functions, the fitted mesh loses none to first order.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from synth.arrays import Floats, Ints
from synth.fem.mesh.element import TRI_POINTS, TRI_WEIGHTS, quality, scatter
from synth.fem.mesh.lattice_stuffing import halve

_REACH, _STEPS, _HALVINGS = 0.5, 6, 6  # search distance in a face's longest sides, steps of it, bisections
_FARTHEST = 0.5  # largest shift of a corner, as a part of its shortest side
_PASSES = 2  # the second reaches surfaces beyond the first one's search distance
_SOUND = 0.2  # least mean ratio of a moved tetrahedron


def fit(points: Floats, cells: Ints, faces: Ints, inside: Callable[[Floats], Floats]) -> Floats:
    """Moves the corners of boundary `faces` (F, 3), counter-clockwise from outside, of a mesh as of `stuff`.

    Returns all points (N, 3) mm. No tetrahedron falls below a mean ratio of 0.2, unless it was below before.
    Measured on a real brain, 1,600 tetrahedra graded towards the opening: volume 82% before, 95% after.
    """
    for _ in range(_PASSES):
        points = _fit_once(points, cells, faces, inside)
    return points


def _fit_once(points: Floats, cells: Ints, faces: Ints, inside: Callable[[Floats], Floats]) -> Floats:
    corner = points[faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    normal = cross / double_area[:, None]
    sides = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2)
    height = _find_heights(np.einsum("qc,fcd->fqd", TRI_POINTS, corner), normal, sides.max(axis=1), inside)

    used, local = np.unique(faces, return_inverse=True)
    local = local.reshape(-1, 3)
    vertex_normal = np.zeros((len(used), 3))
    np.add.at(vertex_normal, local, cross[:, None, :])
    vertex_normal /= np.linalg.norm(vertex_normal, axis=1, keepdims=True) + 1e-30
    tilt = np.einsum("fcd,fd->fc", vertex_normal[local], normal)
    weight = 0.5 * double_area[:, None] * TRI_WEIGHTS
    basis = TRI_POINTS[None] * tilt[:, None, :]
    local_matrix = np.einsum("fq,fqi,fqj->fij", weight, basis, basis)
    matrix = scatter(local_matrix, local, len(used)).tocsc()
    damping = np.full(len(used), 1e-6 * float(matrix.diagonal().mean()))  # regularises
    matrix = matrix + sp.diags_array(damping, format="csc")
    target = np.bincount(local.ravel(), np.einsum("fq,fqi,fq->fi", weight, basis, height).ravel(), len(used))
    shortest = np.full(len(used), np.inf)
    np.minimum.at(shortest, local, sides.min(axis=1)[:, None])
    step = np.clip(spsolve(matrix, target), -_FARTHEST * shortest, _FARTHEST * shortest)
    return _move(points, cells, used, step[:, None] * vertex_normal)


def _move(points: Floats, cells: Ints, used: Ints, step: Floats) -> Floats:
    """Moves the corners by the step, or by as much of it as the quality of their tetrahedra allows."""
    floor = np.minimum(_SOUND, quality(points[cells]))
    share = np.zeros(len(points))
    share[used] = 1.0
    full_step = np.zeros_like(points)
    full_step[used] = step
    for attempt in range(8):
        trial = points + share[:, None] * full_step
        is_bad = quality(trial[cells]) < floor - 1e-12
        if not is_bad.any():
            return trial
        share[cells[is_bad]] *= 0.5 if attempt < 5 else 0.0
    return points


def _find_heights(
    positions: Floats, normal: Floats, longest: Floats, inside: Callable[[Floats], Floats]
) -> Floats:
    """Distance (F, Q) mm along normals (F, 3) from points (F, Q, 3) to the surface; `longest`: (F,) mm."""
    faces, count = positions.shape[:2]
    start, ray = positions.reshape(-1, 3), np.repeat(normal * longest[:, None] * _REACH, count, axis=0)
    is_inside = inside(start) > 0
    ray = np.where(is_inside[:, None], ray, -ray)
    low, high = np.zeros(len(start)), np.ones(len(start))
    is_open = np.ones(len(start), bool)
    for k in range(1, _STEPS + 1):
        rows = np.flatnonzero(is_open)
        if len(rows) == 0:
            break
        has_crossed = (inside(start[rows] + k / _STEPS * ray[rows]) > 0) != is_inside[rows]
        high[rows[has_crossed]] = k / _STEPS
        low[rows] = (k - 1) / _STEPS
        is_open[rows[has_crossed]] = False
    share = halve(inside, start, ray, is_inside, low, high, _HALVINGS)
    signed_share = np.where(is_open, 1.0, share) * np.where(is_inside, 1.0, -1.0)
    return (signed_share * np.repeat(longest * _REACH, count)).reshape(faces, count)
