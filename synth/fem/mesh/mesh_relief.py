"""Shapes the upper boundary of a block after gyri and sulci, as far as its faces allow.

Its nodes' heights are a least-squares fit of the curved faces to the surface, so that details smaller than a
face are averaged rather than hit or missed by a corner.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import map_coordinates
from scipy.sparse.linalg import spsolve

from synth.arrays import Floats, Ints
from synth.fem.mesh.element import jacobians, quality, scatter, shape
from synth.fem.mesh.refine import EDGES

Field = Callable[[Floats], Floats]
"""Height (n,) mm at (n, 2) mm."""

_FADE_MM = 3.0  # width over which the map passes into the field around it
_LATTICE = 7
_PLACES = (
    np.array([(i, j, _LATTICE - 1 - i - j) for i in range(_LATTICE) for j in range(_LATTICE - i)]) + 1 / 3
) / _LATTICE
"""(28, 3) evenly spaced barycentric points on a face."""
_SOUND, _UNBENT = 0.2, 0.4  # least mean ratio, and least Jacobian of a curved element over its straight one's
_TURNS = 100  # measured: default scenes need 1 to 5 of them


@dataclass(frozen=True, eq=False)
class HeightMap:
    """Heights over a square round the opening's centre."""

    height: Floats  # (n, n) mm, on a grid from corner to corner of the square; rows go with y, columns with x
    extent_mm: float  # side of the square

    def blend_into(self, ground: Field) -> Field:
        """The map within its inner circle, passing into another field beyond."""

        def height(xy: Floats) -> Floats:
            half, last = self.extent_mm / 2, len(self.height) - 1
            pixels = (xy / self.extent_mm + 0.5) * last
            map_height = map_coordinates(self.height, [pixels[:, 1], pixels[:, 0]], order=1, mode="nearest")
            s = np.clip((half - np.hypot(xy[:, 0], xy[:, 1])) / _FADE_MM, 0, 1)
            ground_height = ground(xy)
            return np.asarray(ground_height + s * s * (3 - 2 * s) * (map_height - ground_height))

        return height


def raise_top(points: Floats, cells: Ints, faces: Ints, ground: Field, height: Field) -> Floats:
    """Bends a box so that its upper side lies on a height field; only that side's edges are curved then.

    `points`: (N, 3) mm, z from -depth to 0, midsides in the middle of their sides; `cells` (M, 10), `faces`
    (F, 6) of the upper side; `ground`: smooth, the whole box is bent after it; `height`: of the upper side,
    levelled where elements would become too steep.
    """
    corners = int(cells[:, :4].max()) + 1
    sinking = 1 + points[:, 2] / -points[:, 2].min()
    base = points + np.outer(ground(points[:, :2]) * sinking, [0.0, 0.0, 1.0])
    place = np.einsum("qc,fcd->fqd", _PLACES, points[faces[:, :3], :2])
    top, top_height = _fit_heights(points, faces, height(place.reshape(-1, 2)).reshape(place.shape[:2]))
    rise = np.zeros(len(points))
    upper = top[top < corners]
    rise[top] = top_height - base[top, 2]
    lower = np.setdiff1d(np.arange(corners), upper)
    rise[lower] = sinking[lower] * LinearNDInterpolator(points[upper, :2], rise[upper])(points[lower, :2])

    ends = np.zeros((len(points), 2), np.int64)
    ends[:corners] = np.arange(corners)[:, None]
    ends[cells[:, 4:]] = cells[:, EDGES]
    z = base[:, 2] + rise
    bulge = np.where(np.isin(np.arange(len(points)), top), z - z[ends].mean(axis=1), 0.0)
    bent_points, changed_cells = base.copy(), np.arange(len(cells))
    floor = np.minimum(_SOUND, quality(base[cells[:, :4]])) - 1e-12
    for _ in range(_TURNS):
        bent_points[:, 2] = (base[:, 2] + rise)[ends].mean(axis=1) + bulge
        steep_cells = changed_cells[quality(bent_points[cells[changed_cells, :4]]) < floor[changed_cells]]
        bent_cells = changed_cells[jacobians(bent_points, cells[changed_cells]).min(axis=1) < _UNBENT]
        if len(steep_cells) + len(bent_cells) == 0:
            return bent_points
        # An element whose corners rise alike has the shape it had. Levelling a steep one hands part of the
        # slope to its neighbours; lowering its corners instead would leave cliffs around it.
        nodes = cells[steep_cells, :4].ravel()
        count, level = (
            np.bincount(nodes),
            np.bincount(nodes, np.repeat(rise[cells[steep_cells, :4]].mean(axis=1), 4)),
        )
        levelled_nodes = np.flatnonzero(count)
        rise[levelled_nodes] = 0.5 * (rise[levelled_nodes] + level[levelled_nodes] / count[levelled_nodes])
        bulge[np.unique(cells[bent_cells])] *= 0.7
        touched_nodes = np.union1d(levelled_nodes, cells[bent_cells])
        changed_cells = np.flatnonzero(np.isin(cells, touched_nodes).any(axis=1))
    return base


def _fit_heights(points: Floats, faces: Ints, heights: Floats) -> tuple[Ints, Floats]:
    """Nodes (K,) of faces, and their heights (K,) mm by least squares on heights (F, 28) mm at `_PLACES`."""
    corner = points[faces[:, :3], :2]
    side, other = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = 0.5 * np.abs(side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0])
    value = shape(_PLACES)
    local = np.einsum("f,qi,qj->fij", area, value, value)
    nodes, indices = np.unique(faces, return_inverse=True)
    indices = indices.reshape(faces.shape)
    matrix = scatter(local, indices, len(nodes)).tocsc()
    target = np.bincount(indices.ravel(), np.einsum("f,qi,fq->fi", area, value, heights).ravel(), len(nodes))
    return nodes, np.asarray(spsolve(matrix, target))
