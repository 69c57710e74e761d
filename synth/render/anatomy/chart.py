"""Chart for the maps of a patch: its projection on the opening's plane, or its surface unrolled if steep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import xatlas
from scipy.ndimage import distance_transform_edt

from synth.arrays import Floats, Map
from synth.geometry.triangles import grid_faces
from synth.render.anatomy import noise

_COARSE = 48  # side of the unrolled grid: a quarter of a CPU-second; 72 takes one
_STEEP = 1.2  # stretch up to which the projection serves, exceeded at 1% of the opening
_TURNS = 24


@dataclass(frozen=True, eq=False)
class Chart:
    """Map from a patch's projection to a square on which lengths are those of the surface."""

    shift: Map  # (n, n, 2) mm from world x, y; rows go with y, columns with x
    plan_mm: float  # side of the patch
    extent_mm: float  # side of the square

    def at(self, xy: Floats) -> Floats:
        """Chart coordinates (N, 2) of world x, y (N, 2), mm from the square's middle."""
        return np.asarray(xy + noise.sample(self.shift, xy, self.plan_mm))


@lru_cache(maxsize=1)  # sulci and the rim's shade need the same one
def places(chart: Chart, pixels: int) -> Floats:
    """World x, y (pixels^2, 2) mm of the pixels of a map on a chart, row by row."""
    axis = noise.centres(pixels, chart.extent_mm)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2).astype(np.float64)
    xy = grid
    for _ in range(_TURNS if chart.shift.any() else 0):  # a contraction, below a stretch of 2.3
        xy = xy + 0.6 * (grid - chart.at(xy))
    return xy


def unroll(height: Callable[[Floats], Floats], plan_mm: float, radius_mm: float) -> Chart:
    """A chart of the disc of a radius around the middle, extrapolated beyond it.

    Where the surface of the disc is flat enough, the projection on x, y. Else least-squares conformal maps by
    xatlas (B. Levy et al., Least squares conformal maps for automatic texture atlas generation, 2002).

    `height`: (N,) mm of the surface at x, y (N, 2) mm; `plan_mm`: side of the patch.
    """
    axis = noise.centres(_COARSE, plan_mm).astype(np.float64)
    plan = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    vertices = np.column_stack([plan, height(plan)])
    inside = np.hypot(*plan.T) < radius_mm
    slope = np.hypot(*np.gradient(vertices[:, 2].reshape(_COARSE, _COARSE), plan_mm / _COARSE)).ravel()
    shift = np.zeros((_COARSE, _COARSE, 2), np.float32)
    if np.quantile(np.hypot(1, slope[inside]), 0.99) <= _STEEP:
        return Chart(shift, plan_mm, plan_mm)
    faces = grid_faces(_COARSE, _COARSE).reshape(-1, 3)
    faces = faces[inside[faces].all(axis=1)]
    atlas, options = xatlas.Atlas(), xatlas.ChartOptions()
    options.max_cost, options.normal_deviation_weight = 1e9, 0.0  # one piece, however bent
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    atlas.generate(chart_options=options)
    vertex_map, corners, uv = atlas[0]
    if atlas.chart_count != 1:
        return Chart(shift, plan_mm, plan_mm)
    # Turned and moved onto the projection, and scaled to the surface's area: as complex numbers.
    layout = uv.astype(np.float64) @ [atlas.width, 1j * atlas.height]
    projection = plan[vertex_map] @ [1, 1j]
    turn = np.vdot(layout - layout.mean(), projection - projection.mean())
    scale = np.sqrt(
        _area(vertices[vertex_map][corners]) / _area(np.stack([layout.real, layout.imag], -1)[corners])
    )
    offset = projection.mean() + scale * turn / np.abs(turn) * (layout - layout.mean()) - projection
    unmapped = np.ones((_COARSE, _COARSE), bool)
    unmapped.flat[vertex_map] = False
    shift.reshape(-1, 2)[vertex_map] = np.stack([offset.real, offset.imag], axis=-1)
    nearest = distance_transform_edt(unmapped, return_distances=False, return_indices=True)
    return Chart(shift[tuple(nearest)], plan_mm, plan_mm + 2 * float(np.abs(shift).max()))


def _area(corners: Floats) -> float:
    """Total area of triangles (F, 3, 2 or 3)."""
    sides = corners[:, 1:] - corners[:, :1]
    return float(np.sqrt(np.linalg.det(sides @ sides.swapaxes(1, 2))).sum() / 2)
