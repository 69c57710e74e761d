"""The compliance: observed surface displacement under unit loads, the linear map that physics inverts.

Computed by `synth.fem` on a procedural block viewed from straight above, as a recording determines neither
the camera's pose nor the brain's shape; for each `TissueKind` once, in a cache on disk.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy.spatial import Delaunay

from synth.arrays import Floats, Map
from synth.fem import surface_embedding
from synth.fem.membrane import MembraneSheet
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.surface_embedding import Embedding
from synth.fem.system import System, assemble
from synth.formats import COMPLIANCE, MESH
from synth.job import schema
from synth.system import cache

# World (z out of the brain) to camera (x right, y down, z away) for a camera straight above.
TO_CAMERA = np.diag([1.0, -1.0, -1.0])

_ANATOMY = schema.AnatomySection()
OPENING_MM = _ANATOMY.craniotomy.radius_mm
_OPEN = schema.AnatomySection(craniotomy=schema.CraniotomySection(radius_mm=40.0))  # no skull near
# By hand; docs/results/fem/pareto has what elements cost and err.
_POINT_MM = 1.0  # spacing of the points, which reach to the opening's edge
_NODE_MM = 1.2  # spacing of the nodes, which stay as far inside it
_TETS = 3000  # of the map's own mesh, second order
_AT_ONCE = 32  # loads solved at a time: memory
_STORED = 64  # matrices in the cache: three recordings' tissues

Edge = Literal["bonded", "slipping", "free"]


@dataclass(frozen=True)
class TissueKind:
    """Parameters, other than E, that determine the displacement under a load."""

    edge: Edge = "bonded"  # how the skull holds the tissue around the opening; `free`: no skull
    membrane: float = 0.0  # its thickness times Young's modulus over E of the tissue [mm]; 0: none
    poisson: float = 0.4
    stretch: float = 1.0  # of the membrane at rest; above 1 its tension resists bending


@dataclass(frozen=True, eq=False)
class Compliance:
    """Displacement at points of the opening under loads at nodes of it, E = 1 kPa."""

    matrix: Floats
    """(C P, 3 K): displacement [mm], x of every point, then y, then in stereo z (C = 3), under x, y, z loads
    of 1 mN per node."""
    points: Floats  # (P, 2) camera x, y from the opening's centre [mm]
    nodes: Floats  # (K, 2) positions of the loads, same axes [mm]
    node_area: Floats  # (K,) mm^2


@dataclass(frozen=True, eq=False)
class ElasticBlock:
    """A procedural block viewed from straight above, E = 1 kPa."""

    volume: Tets
    system: System

    @classmethod
    def build(cls, tets: int, tissue: TissueKind | None = None) -> ElasticBlock:
        """A linear block of about `tets` second-order tetrahedra."""
        tissue = tissue or TissueKind()
        free = tissue.edge == "free"
        volume = tetrahedra.block(
            _OPEN if free else _ANATOMY,
            tets,
            [(0.0, 0.0, OPENING_MM)] if free else (),
            slips=tissue.edge == "slipping",
        )
        sheet = MembraneSheet(tissue.membrane, tissue.stretch) if tissue.membrane else None
        law = "neo-hookean" if tissue.stretch > 1 else "linear"  # a linear sheet has no tension
        return cls(volume, assemble(volume, law, tissue.poisson, sheet))

    def embed(self, xy: Floats) -> Embedding:
        """The embedding of surface points (P, 2), camera x, y [mm], in the volume."""
        world = xy * np.array([1.0, -1.0])
        on_dome = np.column_stack([world, tetrahedra.dome(world, _ANATOMY.dome_mm)])
        return surface_embedding.embed(self.volume, on_dome)


def picture(embedding: Embedding, moved: Floats, components: int = 2) -> Floats:
    """Motion (P, C, ...) mm of points in camera axes, from a volume's (N, 3, ...) mm in world axes."""
    return np.asarray(np.einsum("ab,pb...->pa...", TO_CAMERA[:components], embedding.move(moved)), np.float64)


def build(components: int, tissue: TissueKind) -> Compliance:
    """The compliance (4 CPU-s, or the cache) of 2 or, in stereo, 3 components of displacement."""
    points, nodes = _lattices()
    matrix = _stored(tissue)[: components * len(points)]
    flat = np.column_stack([nodes, np.zeros(len(nodes))])
    area = surface_embedding.vertex_area(flat, Delaunay(nodes).simplices)
    return Compliance(matrix.astype(np.float64), points, nodes, area)


@lru_cache(maxsize=4)
def _stored(tissue: TissueKind) -> Map:
    """The matrix (3 P, 3 K) from this user's cache, or solved and stored there."""
    key = f"{MESH} {COMPLIANCE} {_TETS} {_POINT_MM} {_NODE_MM} {OPENING_MM} {tissue}".encode()
    faults = ValueError, EOFError  # of files that were cut off by a full disk: they are computed again
    return cache.cached("compliance/npy", key, lambda: _solved(tissue), _dump, _load, faults, _STORED)


def _dump(matrix: Map) -> bytes:
    np.save(held := io.BytesIO(), matrix)
    return held.getvalue()


def _load(data: bytes) -> Map:
    return np.asarray(np.load(io.BytesIO(data), allow_pickle=False))


def _lattices() -> tuple[Floats, Floats]:
    """Points (P, 2) and nodes (K, 2) [mm]."""
    return _disc(_POINT_MM, OPENING_MM), _disc(_NODE_MM, OPENING_MM - _NODE_MM)


def _solved(tissue: TissueKind) -> Map:
    """The matrix: one linear problem per node and axis, with one factorisation."""
    block, (points, nodes) = ElasticBlock.build(_TETS, tissue), _lattices()
    observed, loaded = block.embed(points), block.embed(nodes)
    columns = np.empty((len(nodes), 3, 3, len(points)), np.float32)
    for some in np.array_split(np.arange(len(nodes)), max(1, len(nodes) // _AT_ONCE)):
        for axis in range(3):
            unit = np.einsum("kl,a->kal", np.eye(len(nodes))[:, some], TO_CAMERA[axis])
            u = block.system.solve(loaded.gather(unit))
            columns[some, axis] = picture(observed, u, 3).transpose(2, 1, 0)
    return columns.transpose(2, 3, 0, 1).reshape(3 * len(points), 3 * len(nodes))


def _disc(spacing_mm: float, radius_mm: float) -> Floats:
    """Square lattice inside a circle, (N, 2) mm."""
    steps = np.arange(-np.floor(radius_mm / spacing_mm), np.floor(radius_mm / spacing_mm) + 1) * spacing_mm
    x, y = np.meshgrid(steps, steps)
    return np.stack([x, y], axis=-1)[np.hypot(x, y) <= radius_mm]
