"""What unit loads on the surface do to what a camera sees: the linear map that the inverse baselines invert.

Built from `synth.fem` on a procedural block seen straight from above, with a mesh of its own. A recording
doesn't tell the pose of the camera or the shape of the brain, so neither does the map know them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from synth import job
from synth.fem import mesh, skin
from synth.fem.system import assemble

Floats = NDArray[np.float64]

# World (z out of the brain) to camera (x right, y down, z forward) for a camera straight above.
TO_CAMERA = np.diag([1.0, -1.0, -1.0])

_AT_ONCE = 32


@dataclass(frozen=True, eq=False)
class Compliance:
    """Displacement seen at points of the opening for loads at nodes of it, E = 1 kPa."""

    matrix: Floats
    """(2 P, 3 K): in-plane displacement [mm], x of every point, then y, for x, y, z loads of 1 mN a node."""
    points: Floats
    """(P, 2) where displacement is seen, camera x, y from the opening's centre [mm]."""
    nodes: Floats
    """(K, 2) where loads stand, same axes [mm]."""
    node_area: Floats
    """(K,) mm^2."""


@lru_cache(maxsize=4)
def build(
    point_mm: float = 1.0,
    node_mm: float = 1.2,
    tets: int = 3000,
    poisson: float = 0.4,
    radius_mm: float = 12.0,
) -> Compliance:
    """Solves one linear problem a node and axis, on one factorisation.

    Args:
        point_mm: spacing of the points.
        node_mm: spacing of the nodes.
        tets: of the map's own mesh, second order.
        poisson: of the tissue.
        radius_mm: of the opening; points reach to it, nodes stay a spacing inside.
    """
    anatomy = job.Anatomy(craniotomy=job.Craniotomy(radius_mm=radius_mm))
    volume = mesh.block(anatomy, tets, 2)
    system = assemble(volume, "linear", poisson)
    points, nodes = _disc(point_mm, radius_mm), _disc(node_mm, radius_mm - node_mm)
    seen = skin.embedding(volume, on_dome(points, anatomy.dome_mm))
    held = skin.embedding(volume, on_dome(nodes, anatomy.dome_mm))
    columns = np.empty((len(nodes), 3, 2, len(points)))
    for some in np.array_split(np.arange(len(nodes)), max(1, len(nodes) // _AT_ONCE)):
        carry = held[some].toarray()
        for axis in range(3):
            u = system.solve(np.einsum("kn,a->nak", carry, TO_CAMERA[axis]))
            at_points = np.stack([seen @ part for part in u.transpose(1, 0, 2)])
            columns[some, axis] = np.einsum("ba,apk->kbp", TO_CAMERA, at_points)[:, :2]
    matrix = columns.transpose(2, 3, 0, 1).reshape(2 * len(points), 3 * len(nodes))
    return Compliance(matrix, points, nodes, _areas(nodes))


def _disc(spacing_mm: float, radius_mm: float) -> Floats:
    """Square lattice inside a circle, (N, 2) mm."""
    steps = np.arange(-np.floor(radius_mm / spacing_mm), np.floor(radius_mm / spacing_mm) + 1) * spacing_mm
    x, y = np.meshgrid(steps, steps)
    return np.stack([x, y], axis=-1)[np.hypot(x, y) <= radius_mm]


def on_dome(xy: Floats, dome_mm: float) -> Floats:
    """Camera x, y to the world's surface, (N, 3) mm."""
    world = xy * np.array([1.0, -1.0])
    return np.column_stack([world, mesh.dome(world, dome_mm)])


def _areas(nodes: Floats) -> Floats:
    """A third of the triangles round each node, mm^2."""
    flat = np.column_stack([nodes, np.zeros(len(nodes))])
    return skin.vertex_area(flat, Delaunay(nodes).simplices)
