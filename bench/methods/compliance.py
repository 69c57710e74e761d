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

from synth.fem import surface_embedding
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.surface_embedding import Embedding
from synth.fem.system import System, assemble
from synth.job import schema

Floats = NDArray[np.float64]

# World (z out of the brain) to camera (x right, y down, z away) for a camera straight above.
TO_CAMERA = np.diag([1.0, -1.0, -1.0])

# A recording doesn't tell the brain's shape: the default job's.
_ANATOMY = schema.AnatomySection()
_AT_ONCE = 32


@dataclass(frozen=True, eq=False)
class Compliance:
    """Displacement seen at points of the opening for loads at nodes of it, E = 1 kPa."""

    matrix: Floats
    """(C P, 3 K): displacement [mm], x of every point, then y, then z if a second eye sees it (C = 3), for x,
    y, z loads of 1 mN a node."""
    points: Floats
    """(P, 2) where displacement is seen, camera x, y from the opening's centre [mm]."""
    nodes: Floats
    """(K, 2) where loads stand, same axes [mm]."""
    node_area: Floats
    """(K,) mm^2."""


@dataclass(frozen=True, eq=False)
class ElasticBlock:
    """A procedural block seen from straight above, E = 1 kPa."""

    volume: Tets
    system: System

    @classmethod
    def build(cls, tets: int) -> ElasticBlock:
        """A linear block of about that many second-order tetrahedra, with Poisson's ratio 0.4."""
        volume = tetrahedra.block(_ANATOMY, tets)
        return cls(volume, assemble(volume, "linear", 0.4))

    def embed(self, xy: Floats) -> Embedding:
        """How surface points (P, 2), camera x, y [mm], ride on the volume."""
        world = xy * np.array([1.0, -1.0])
        on_dome = np.column_stack([world, tetrahedra.dome(world, _ANATOMY.dome_mm)])
        return surface_embedding.embed(self.volume, on_dome)


def picture(embedding: Embedding, moved: Floats, components: int = 2) -> Floats:
    """What the camera sees, (P, C, ...) mm at points, of a volume's motion (N, 3, ...) mm in world axes."""
    return np.asarray(np.einsum("ab,pb...->pa...", TO_CAMERA[:components], embedding.move(moved)), np.float64)


@lru_cache(maxsize=4)
def build(point_mm: float = 1.0, node_mm: float = 1.2, tets: int = 3000, components: int = 2) -> Compliance:
    """Solves one linear problem a node and axis, on one factorisation.

    Args:
        point_mm: spacing of the points, which reach to the opening's edge.
        node_mm: spacing of the nodes, which stay as far inside it.
        tets: of the map's own mesh, second order.
        components: of the displacement that is seen: 2 by one eye, 3 by two.
    """
    block = ElasticBlock.build(tets)
    radius_mm = _ANATOMY.craniotomy.radius_mm
    points, nodes = _disc(point_mm, radius_mm), _disc(node_mm, radius_mm - node_mm)
    seen, held = block.embed(points), block.embed(nodes)
    columns = np.empty((len(nodes), 3, components, len(points)))
    for some in np.array_split(np.arange(len(nodes)), max(1, len(nodes) // _AT_ONCE)):
        for axis in range(3):
            unit = np.einsum("kl,a->kal", np.eye(len(nodes))[:, some], TO_CAMERA[axis])
            u = block.system.solve(held.gather(unit))
            columns[some, axis] = picture(seen, u, components).transpose(2, 1, 0)
    matrix = columns.transpose(2, 3, 0, 1).reshape(components * len(points), 3 * len(nodes))
    flat = np.column_stack([nodes, np.zeros(len(nodes))])
    return Compliance(matrix, points, nodes, surface_embedding.vertex_area(flat, Delaunay(nodes).simplices))


def _disc(spacing_mm: float, radius_mm: float) -> Floats:
    """Square lattice inside a circle, (N, 2) mm."""
    steps = np.arange(-np.floor(radius_mm / spacing_mm), np.floor(radius_mm / spacing_mm) + 1) * spacing_mm
    x, y = np.meshgrid(steps, steps)
    return np.stack([x, y], axis=-1)[np.hypot(x, y) <= radius_mm]
