"""One contact on the procedural brain: displacement under a load by law and mesh."""

from dataclasses import dataclass

import numpy as np

from synth.arrays import Floats, Indices, Mask
from synth.fem import equilibrium, surface_embedding, tool_gesture
from synth.fem.mesh import tetrahedra
from synth.fem.surface_embedding import Embedding
from synth.fem.system import System, assemble
from synth.geometry.triangles import grid_faces
from synth.job import schema

ANATOMY = schema.AnatomySection()
DIRECTIONS = {"push": (0.0, 0.0, -1.0), "pull": (0.0, 0.0, 1.0), "aside": (0.87, 0.0, 0.5)}
CONTACTS = ((0.0, 0.0, 4.5), (5.0, 2.0, 3.0), (-3.0, -5.0, 6.0), (-2.0, 6.0, 3.5))
"""x, y and radius, mm, world axes: the default range of radii, near the centre and near the rim."""


@dataclass(frozen=True)
class Patch:
    """The dome over the opening as a fine surface."""

    vertices: Floats
    faces: Indices
    area: Floats
    opening: Mask  # (V,) in the opening, where errors are measured


def patch(vertices: int = 40_000, extent: float = 46.0) -> Patch:
    """A square grid on the dome."""
    n = round(vertices**0.5)
    x = np.linspace(-extent / 2, extent / 2, n)
    xy = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    faces = np.concatenate(grid_faces(n, n))
    points = np.column_stack([xy, tetrahedra.dome(xy, ANATOMY.dome_mm)])
    inside = np.hypot(*xy.T) < ANATOMY.craniotomy.radius_mm
    return Patch(points, faces, surface_embedding.vertex_area(points, faces), inside)


@dataclass(frozen=True)
class Brain:
    """A mesh refined under one contact, its equations and the surface embedded in it."""

    system: System
    embedding: Embedding
    kernel: Floats  # (V,) share of a unit force at every vertex
    radius_mm: float

    def load(self, load: float, direction: str) -> Floats:
        """(N, 3) mN for E = 1 kPa at P = `load`."""
        return self.embedding.gather(
            np.outer(self.kernel, load * self.radius_mm**2 * np.array(DIRECTIONS[direction]))
        )


def brain(
    surface: Patch, law: str, tets: int, contact: tuple[float, float, float], poisson: float = 0.4
) -> Brain:
    """Mesh, equations and embedded surface of one contact."""
    volume = tetrahedra.block(tets, (contact,))
    embedding = surface_embedding.embed(volume, surface.vertices)
    pressure = tool_gesture.footprint(np.array(contact[:2]), contact[2], surface.vertices, surface.area)
    system = assemble(volume, law, poisson)
    return Brain(system, embedding, surface.area * pressure, contact[2])


def solve_displacement(case: Brain, load: float, direction: str, steps: int = 3) -> Floats:
    """Displacement (V, 3) mm under a load that is raised in a few steps."""
    part = np.linspace(0, 1, steps + 1)
    path = equilibrium.solve_path(case.system, part[:, None, None] * case.load(load, direction), load * part)
    return case.embedding.move(path.displacement[-1])


def error(u: Floats, exact: Floats, surface: Patch) -> float:
    """Relative root mean square over the opening."""
    return float(np.linalg.norm((u - exact)[surface.opening]) / np.linalg.norm(exact[surface.opening]))
