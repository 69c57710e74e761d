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
_NODE_MM = 1.2  # spacing of the nodes, which stay as far inside it
_TETS = 3000  # of the map's own mesh, second order

SETTINGS = _POINT_MM, _NODE_MM, _TETS
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
    points, nodes = _disc(_POINT_MM, OPENING_MM), _disc(_NODE_MM, OPENING_MM - _NODE_MM)
    flat = np.column_stack([nodes, np.zeros(len(nodes))])
    return Lattice(points, nodes, surface_embedding.vertex_area(flat, Delaunay(nodes).simplices))


def solve(tissue: TissueKind, components: int) -> Floats:
    """Displacement (C P, 3 K) mm of a tissue of E = 1 kPa under unit loads [mN].

    Rows: x of every point, then y, then in stereo z (C = 3); columns: loads along x at every node, then y, z.
    """
    surface = _condense("free" if tissue.edge == "free" else "held", tissue.poisson)
    window, rows = len(surface.loads), components * len(lattice().points)
    rest = slice(len(surface.stiffness) - window)  # of the surface, around the window
    within = slice(rest.stop, None)
    added = surface.assemble_added(tissue)

    def part(rows: slice, columns: slice, kind: type[np.floating]) -> NDArray[np.floating]:
        dense, sparse = surface.stiffness[rows, columns].astype(kind), sp.coo_array(added[rows, columns])
        dense[sparse.row, sparse.col] += sparse.data.astype(kind)
        return dense

    # What surrounds the window is eliminated in single precision, at half the cost and with errors of 1e-6.
    # All are symmetric or of one triangle, in Fortran's order: BLAS copies and mirrors nothing.
    root = cholesky(part(rest, rest, np.float32).T, lower=True, overwrite_a=True, check_finite=False)
    taken = strsm(1.0, root, part(within, rest, np.float32).T, lower=1, overwrite_b=1)
    held = part(within, within, np.float64).T
    held -= ssyrk(1.0, taken, trans=1, lower=1)
    root = cholesky(held, lower=True, overwrite_a=True, check_finite=False)
    moved = dtrsm(1.0, root, surface.loads, lower=1)
    moved = dtrsm(1.0, root, moved, lower=1, trans_a=1, overwrite_b=1)
    return np.asarray(surface.observed[:rows] @ moved, np.float64)


@dataclass(frozen=True, eq=False)
class _Surface:
    """A block of one Poisson's ratio, without skull or membrane, with all below its surface eliminated.

    Its nodes are those of the surface and, last, the window: those that bear the loads or move the points.
    """

    volumes: dict[Edge, Tets]  # by edge: one mesh, with the skull's springs
    nodes: Ints  # (S,) of the volume
    stiffness: Floats  # (3 S, 3 S) mN/mm
    observed: Floats  # (3 P, 3 W) motion of the points, x, y, z in turn, by that of the window's nodes
    loads: Floats  # (3 W, 3 K) forces on the window's nodes by unit loads

    def assemble_added(self, tissue: TissueKind) -> sp.csr_array:
        """What skull and membrane add to the stiffness, (3 S, 3 S) mN/mm."""
        volume = self.volumes[tissue.edge]
        stiffness = springs(volume)
        if tissue.membrane:
            sheet = MembraneSheet(tissue.membrane, tissue.stretch)
            stiffness = stiffness + lay(volume, sheet, linear=tissue.stretch <= 1).rest_stiffness()
        rows = degrees_of_freedom(self.nodes)
        return sp.csr_array(stiffness.tocsr()[rows][:, rows])


Block = Literal["held", "free"]


@lru_cache(maxsize=1)
def _condense(block: Block, poisson: float) -> _Surface:
    volumes, nodes, observed, loads = _geometry(block)
    volume = next(iter(volumes.values()))
    tissue, _ = tissue_stiffness(quadrature(volume.points, volume.cells), poisson)
    stiffness = condense(tissue, volume.points, volume.cells, nodes, volume.fixed)
    return _Surface(volumes, nodes, stiffness, observed, loads)


@lru_cache(maxsize=1)
def _geometry(block: Block) -> tuple[dict[Edge, Tets], Ints, Floats, Floats]:
    """What of a `_Surface` depends on no Poisson's ratio: volumes, nodes, observed, loads."""
    edges: tuple[Edge, ...] = ("free",) if block == "free" else ("bonded", "slipping")
    volumes, where = {edge: _mesh(_TETS, edge) for edge in edges}, lattice()
    volume = volumes[edges[0]]
    embedded = [_embed(volume, xy) for xy in (where.points, where.nodes)]
    moving = [np.union1d(each.value.indices, each.spin.indices // 3) for each in embedded]
    window = np.union1d(*moving)
    surface = np.setdiff1d(tetrahedra.boundary(volume.cells), window)
    nodes = np.concatenate([surface[~volume.fixed[surface]], window])
    observed, loads = (_motion(each, window) for each in embedded)
    return volumes, nodes, observed, loads.T  # in Fortran's order


def _motion(embedding: Embedding, window: Ints) -> Floats:
    """Motion (3 V, 3 W) of V points along the camera's x, then y, then z, by that of a window's nodes.

    It is `Embedding.move` of unit motions of the window's nodes.
    """
    count = embedding.value.shape[0]
    moved = np.kron(embedding.value[:, window].toarray(), np.eye(3)).reshape(count, 3, -1)
    spin = embedding.spin[:, degrees_of_freedom(window)].toarray()
    turned = embedding.corner @ embedding.mean @ spin.reshape(len(embedding.mean), -1)
    moved += np.cross(turned.reshape(moved.shape), embedding.arm[:, :, None], axis=1)
    return np.asarray(np.einsum("ab,vbw->avw", TO_CAMERA, moved).reshape(3 * count, -1), np.float64)


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
