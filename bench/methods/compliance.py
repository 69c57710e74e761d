"""The compliance: observed surface displacement under unit loads, the linear map that physics inverts.

Computed by `synth.fem` on a procedural block viewed from straight above, as a recording determines neither
the camera's pose nor the brain's shape. Of a block and Poisson's ratio the stiffness is computed once, with
all below the surface eliminated: the skull's hold and a membrane only add to the surface's stiffness.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.linalg.blas import dtrsm, ssyrk, strsm
from scipy.spatial import Delaunay

from synth.arrays import Floats, Ints
from synth.fem import surface_embedding
from synth.fem.condensation import condense, degrees_of_freedom
from synth.fem.membrane import MembraneSheet, lay
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.element import quadrature
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.surface_embedding import Embedding
from synth.fem.system import System, assemble, springs, tissue_stiffness

# World (z out of the brain) to camera (x right, y down, z away) for a camera straight above.
TO_CAMERA = np.diag([1.0, -1.0, -1.0])

OPENING_MM = 12.0
"""Radius of the opening in the skull, a job's default."""
DOME_MM = 70.0  # radius of curvature of the surface, likewise
_OPEN_MM = 40.0  # radius of an opening without skull near
# By hand; docs/results/fem/pareto has what elements cost and err.
_POINT_MM = 1.0  # spacing of the points, which reach to the opening's edge
NODE_MM = 1.2  # spacing of the nodes that bear loads, which stay as far inside it
_TETS = 3000  # of the map's own mesh, second order

SETTINGS = _POINT_MM, NODE_MM, _TETS
"""Settings of every compliance, for the key of what is kept on disk."""

Edge = Literal["bonded", "slipping", "free"]


@dataclass(frozen=True)
class TissueKind:
    """Parameters, other than E, that determine the displacement under a load."""

    edge: Edge = "bonded"  # how the skull holds the tissue around the opening; `free`: no skull
    membrane: float = 0.0  # its thickness times Young's modulus over E of the tissue [mm]; 0: none
    poisson: float = 0.4
    stretch: float = 1.0  # of the membrane at rest; above 1 its tension resists bending


@dataclass(frozen=True, eq=False)
class Lattice:
    """Where displacement is observed and loads act, in the opening."""

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
        volume = _mesh(tets, tissue.edge)
        sheet = MembraneSheet(tissue.membrane, tissue.stretch) if tissue.membrane else None
        law = "neo-hookean" if tissue.stretch > 1 else "linear"  # a linear sheet has no tension
        return cls(volume, assemble(volume, law, tissue.poisson, sheet))

    def embed(self, xy: Floats) -> Embedding:
        """The embedding of surface points (P, 2), camera x, y [mm], in the volume."""
        return _embed(self.volume, xy)


def picture(embedding: Embedding, moved: Floats, components: int = 2) -> Floats:
    """Motion (P, C, ...) mm of points in camera axes, from a volume's (N, 3, ...) mm in world axes."""
    return np.asarray(np.einsum("ab,pb...->pa...", TO_CAMERA[:components], embedding.move(moved)), np.float64)


@lru_cache(maxsize=1)
def lattice() -> Lattice:
    """Points and nodes of every compliance."""
    points, nodes = _disc(_POINT_MM, OPENING_MM), _disc(NODE_MM, OPENING_MM - NODE_MM)
    flat = np.column_stack([nodes, np.zeros(len(nodes))])
    return Lattice(points, nodes, surface_embedding.vertex_area(flat, Delaunay(nodes).simplices))


def solve(tissue: TissueKind, components: int, *, alone: bool = False) -> Floats:
    """Displacement (C P, 3 K) mm of a tissue of E = 1 kPa under unit loads [mN].

    Rows: x of every point, then y, then in stereo z (C = 3); columns: loads along x at every node, then y, z.
    `alone`: no other tissue of this Poisson's ratio is expected, so that nothing is kept for it, at half the
    cost of the first.
    """
    block: Block = "free" if tissue.edge == "free" else "held"
    geometry, rows = _geometry(block), components * len(lattice().points)
    stiffness = _hold_alone(geometry, tissue) if alone else _hold(_condense(block, tissue.poisson), tissue)
    root = cholesky(stiffness, lower=True, overwrite_a=True, check_finite=False)
    motion = dtrsm(1.0, root, geometry.loads, lower=1)
    motion = dtrsm(1.0, root, motion, lower=1, trans_a=1, overwrite_b=1)
    return np.asarray(geometry.observed[:rows] @ motion, np.float64)


@dataclass(frozen=True, eq=False)
class _Geometry:
    """A block: what depends on no Poisson's ratio.

    Its nodes are those of the surface and, last, the window: those that bear the loads or move the points.
    """

    volumes: dict[Edge, Tets]  # by edge: one mesh, with the skull's springs
    nodes: Ints  # (S,) of the volume
    observed: Floats  # (3 P, 3 W) motion of the points, x, y, z in turn, by that of the window's nodes
    loads: Floats  # (3 W, 3 K) forces on the window's nodes by unit loads

    def assemble_tissue(self, poisson: float) -> sp.csr_array:
        """The stiffness of the volume without skull or membrane, (3 N, 3 N) mN/mm."""
        volume = next(iter(self.volumes.values()))
        return tissue_stiffness(quadrature(volume.points, volume.cells), poisson)[0]

    def assemble_added(self, tissue: TissueKind) -> sp.csr_array:
        """What skull and membrane add to it, (3 N, 3 N) mN/mm: to nodes of the surface alone."""
        volume = self.volumes[tissue.edge]
        stiffness = springs(volume)
        if tissue.membrane:
            sheet = MembraneSheet(tissue.membrane, tissue.stretch)
            stiffness = stiffness + lay(volume, sheet, linear=tissue.stretch <= 1).rest_stiffness()
        return stiffness.tocsr()


@dataclass(frozen=True, eq=False)
class _Surface:
    """The stiffness of a block without skull or membrane, with all below its surface eliminated.

    In Fortran's order, and that of the nodes around the window in single precision.
    """

    geometry: _Geometry
    outer: NDArray[np.float32]  # (3 R, 3 R) mN/mm, of the nodes around the window
    coupling: NDArray[np.float32]  # (3 R, 3 W) from the window to them
    window: Floats  # (3 W, 3 W)


def _hold(surface: _Surface, tissue: TissueKind) -> Floats:
    """The stiffness (3 W, 3 W) of the window under skull and membrane; only the lower triangle is right."""
    rows = degrees_of_freedom(surface.geometry.nodes)
    added_stiffness = surface.geometry.assemble_added(tissue)[rows][:, rows]
    outer, inner = slice(len(surface.outer)), slice(len(surface.outer), None)

    def add(dense: NDArray[np.floating], part: sp.csr_array) -> NDArray[np.floating]:
        total, sparse = dense.copy(order="F"), sp.coo_array(part)
        total[sparse.row, sparse.col] += sparse.data.astype(total.dtype)
        return total

    # What surrounds the window is eliminated in single precision, at half the cost and with errors of 1e-6.
    # All are symmetric or of one triangle, in Fortran's order: BLAS copies and mirrors nothing.
    root = cholesky(
        add(surface.outer, added_stiffness[outer, outer]), lower=True, overwrite_a=True, check_finite=False
    )
    coupling = strsm(1.0, root, add(surface.coupling, added_stiffness[outer, inner]), lower=1, overwrite_b=1)
    window = add(surface.window, added_stiffness[inner, inner])
    window -= ssyrk(1.0, coupling, trans=1, lower=1)
    return np.asarray(window, np.float64)


def _hold_alone(geometry: _Geometry, tissue: TissueKind) -> Floats:
    """The same by eliminating all but the window, without the step over the surface."""
    volume, window = geometry.volumes[tissue.edge], geometry.nodes[-(len(geometry.loads) // 3) :]
    stiffness = geometry.assemble_tissue(tissue.poisson) + geometry.assemble_added(tissue)
    return condense(stiffness, volume.points, volume.cells, window, volume.fixed).T


Block = Literal["held", "free"]
_BLOCKS = 2  # kept in memory: where the tissue's edge isn't seen a search goes from one to the other


@lru_cache(maxsize=_BLOCKS)
def _condense(block: Block, poisson: float) -> _Surface:
    geometry = _geometry(block)
    volume = next(iter(geometry.volumes.values()))
    tissue = geometry.assemble_tissue(poisson)
    stiffness = condense(tissue, volume.points, volume.cells, geometry.nodes, volume.fixed).T
    outer, inner = (
        slice(len(stiffness) - len(geometry.loads)),
        slice(len(stiffness) - len(geometry.loads), None),
    )
    outer_part, coupling = (np.asfortranarray(stiffness[outer, part], np.float32) for part in (outer, inner))
    return _Surface(geometry, outer_part, coupling, np.asfortranarray(stiffness[inner, inner]))


@lru_cache(maxsize=_BLOCKS)
def _geometry(block: Block) -> _Geometry:
    edges: tuple[Edge, ...] = ("free",) if block == "free" else ("bonded", "slipping")
    volumes, grid = {edge: _mesh(_TETS, edge) for edge in edges}, lattice()
    volume = volumes[edges[0]]
    embeddings = [_embed(volume, xy) for xy in (grid.points, grid.nodes)]
    moving_nodes = [
        np.union1d(embedding.value.indices, embedding.spin.indices // 3) for embedding in embeddings
    ]
    window = np.union1d(*moving_nodes)
    surface = np.setdiff1d(tetrahedra.boundary(volume.cells), window)
    nodes = np.concatenate([surface[~volume.fixed[surface]], window])
    observed, loads = (_motion(embedding, window) for embedding in embeddings)
    return _Geometry(volumes, nodes, observed, loads.T)  # in Fortran's order


def _motion(embedding: Embedding, window: Ints) -> Floats:
    """Motion (3 V, 3 W) of V points along the camera's x, then y, then z, by that of a window's nodes.

    It is `Embedding.move` of unit motions of the window's nodes.
    """
    count = embedding.value.shape[0]
    motion = np.kron(embedding.value[:, window].toarray(), np.eye(3)).reshape(count, 3, -1)
    spin = embedding.spin[:, degrees_of_freedom(window)].toarray()
    rotation = embedding.corner @ embedding.mean @ spin.reshape(len(embedding.mean), -1)
    motion += np.cross(rotation.reshape(motion.shape), embedding.arm[:, :, None], axis=1)
    return np.asarray(np.einsum("ab,vbw->avw", TO_CAMERA, motion).reshape(3 * count, -1), np.float64)


def _mesh(tets: int, edge: Edge) -> Tets:
    if edge == "free":
        return tetrahedra.block(tets, [(0.0, 0.0, OPENING_MM)], opening_mm=_OPEN_MM, dome_mm=DOME_MM)
    return tetrahedra.block(tets, opening_mm=OPENING_MM, dome_mm=DOME_MM, slips=edge == "slipping")


def _embed(volume: Tets, xy: Floats) -> Embedding:
    world = xy * np.array([1.0, -1.0])
    return surface_embedding.embed(volume, np.column_stack([world, tetrahedra.dome(world, DOME_MM)]))


def _disc(spacing_mm: float, radius_mm: float) -> Floats:
    """Square lattice inside a circle, (N, 2) mm."""
    steps = np.arange(-np.floor(radius_mm / spacing_mm), np.floor(radius_mm / spacing_mm) + 1) * spacing_mm
    x, y = np.meshgrid(steps, steps)
    return np.stack([x, y], axis=-1)[np.hypot(x, y) <= radius_mm]
