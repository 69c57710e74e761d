"""Ogden's law and driven contacts by felupe: writes `felupe_ogden.json`, what ours is measured against.

Run it with a Python that has felupe (GPL: it judges and never ships) and pypardiso:

    python evidence/fem/felupe_ogden.py

`points`: stress and tangent of the law at deformation gradients. `scenes`: a block of 40 x 40 x 20 mm, E 1
kPa, fixed but for its top, on which a layer of springs k0 (1 - (r/a)^2)^2 joins a disc to an instrument that
is driven. `openings`: likewise, but of 60 x 60 x 40 mm and held beyond 12 mm on its top too, as by a skull,
with the motion of the surface there: what a method sees that estimates the force. `balls`: a rigid ball
without friction is pressed into the block of `scenes` instead, by a penalty where it would overlap: how far
contacts that only press differ from those that stick. On elements a third finer (8, not 6, to the radius;
scenes of 7 and 11 mm) reactions change by less than 0.2% and motion by less than 0.6% of the largest.

Of felupe are the law (its Ogden energy, differentiated automatically) and the elements (bricks of
20 nodes); of this file the springs, on the same faces, and Newton's loop. Half of the block is solved.
"""

import json
from functools import partial
from pathlib import Path

import felupe as fem
import numpy as np
import pypardiso
import scipy.sparse as sp
import tensortrax.math as tm
from felupe.constitution.tensortrax import Hyperelastic
from felupe.constitution.tensortrax.models.hyperelastic import ogden

FIRM = 40.0  # k0 over E/a
PENALTY = 200.0  # kPa/mm, for E = 1 kPa
SCENES = [  # Poisson's ratio, alpha, radius of the disc and travel of the instrument in mm
    (0.45, -5.0, 5.0, [0.0, 0.0, -3.0]),
    (0.45, -5.0, 5.0, [3.0, 0.0, 0.0]),
    (0.45, -15.0, 5.0, [0.0, 0.0, -4.0]),
    (0.45, -15.0, 5.0, [2.0, 0.0, 3.0]),
    (0.45, -5.0, 9.0, [0.0, 0.0, -6.0]),
    (0.45, -8.0, 7.0, [3.0, 0.0, -4.0]),
    (0.45, -12.0, 9.0, [4.0, 0.0, 6.0]),
    (0.45, -8.0, 11.0, [0.0, 0.0, -8.0]),
]
OPENINGS = [  # likewise, with the disc's middle
    (0.45, -5.0, 5.0, [0.0, 0.0, -4.0], 0.0),
    (0.45, -8.0, 6.0, [1.0, 0.0, -3.0], 2.0),
    (0.45, -12.0, 5.0, [4.0, 0.0, 0.0], 0.0),
    (0.45, -15.0, 6.0, [1.0, 0.0, 4.0], -2.0),
]
OPENING = 12.0  # mm
BALLS = [(0.45, -8.0, 6.0, depth) for depth in (0.5, 1.0, 2.0, 3.0, 4.0)]  # ratio, alpha, radius, depth in mm
PLACES = [[0, 0], [2.5, 0], [-2.5, 0], [0, 5], [6, 0], [-6, 0], [0, 8], [10, 0], [-10, 0]]


def energy(C, mu, lam, alpha):
    return ogden(C, mu=[mu], alpha=[alpha]) + (lam / 2 + mu / 3) * (0.5 * tm.log(tm.linalg.det(C))) ** 2


def lame(poisson):
    return 1 / (2 * (1 + poisson)), poisson / ((1 + poisson) * (1 - 2 * poisson))


def points():
    rng, rows = np.random.default_rng(0), []
    for poisson, alpha in ((0.45, -4.7), (0.4, -15.0), (0.49, 3.0)):
        f = np.eye(3) + 0.25 * rng.uniform(-1, 1, (6, 3, 3))
        law = Hyperelastic(energy, mu=lame(poisson)[0], lam=lame(poisson)[1], alpha=alpha)
        gradients = np.ascontiguousarray(np.moveaxis(f, 0, -1))[..., None]
        stress, tangent = law.gradient([gradients, None])[0], law.hessian([gradients, None])[0]
        rows.append(
            {
                "poisson": poisson,
                "alpha": alpha,
                "f": f.tolist(),
                "stress": np.moveaxis(stress[..., 0], -1, 0).tolist(),
                "tangent": np.moveaxis(tangent[..., 0], -1, 0).tolist(),
            }
        )
    return rows


class Layer:
    """Springs between the top and an instrument."""

    def __init__(self, field, mesh, radius, travel, middle):
        self.field, self.travel, self.fraction = field, np.array(travel), 0.0
        top = mesh.points[:, 2] > -1e-9
        region = fem.RegionQuadraticHexahedronBoundary(mesh, only_surface=True, mask=top)
        cells, size = region.mesh.cells, len(mesh.points)
        h = np.broadcast_to(region.h, (*region.h.shape[:2], len(cells)))  # nodes, points, cells
        place = np.einsum("cai,aqc->qci", mesh.points[cells], h)
        r = np.hypot(place[..., 0] - middle, place[..., 1]) / radius
        weight = FIRM / radius * np.maximum(1 - r**2, 0) ** 2 * region.dV
        local, n = np.einsum("qc,aqc,bqc->cab", weight, h, h), cells.shape[1]
        rows, columns = np.repeat(cells, n, axis=1).ravel(), np.tile(cells, (1, n)).ravel()
        nodal = sp.csr_matrix((local.ravel(), (rows, columns)), shape=(size, size))
        self.springs = sp.csr_matrix(sp.kron(nodal, np.eye(3)))
        self.load = np.zeros(size)
        np.add.at(self.load, cells, np.einsum("qc,aqc->ca", weight, h))

    def force(self):
        u = self.field[0].values.ravel()
        return np.kron(self.load, self.fraction * self.travel) - self.springs @ u

    def stiffness(self):
        return self.springs


class Ball:
    """A rigid ball without friction that touches the top at rest, and is pressed in by a penalty."""

    def __init__(self, field, mesh, radius, depth):
        self.field, self.radius, self.depth, self.fraction, self.touched = field, radius, depth, 0.0, 0.0
        top = mesh.points[:, 2] > -1e-9
        region = fem.RegionQuadraticHexahedronBoundary(mesh, only_surface=True, mask=top)
        self.cells, self.points, self.area = region.mesh.cells, mesh.points, region.dV
        self.h = np.broadcast_to(region.h, (*region.h.shape[:2], len(self.cells)))

    def overlap(self):
        """Overlap (q, c) mm at quadrature points, and unit vectors (q, c, 3) out of the ball."""
        place = np.einsum("cai,aqc->qci", (self.points + self.field[0].values)[self.cells], self.h)
        offset = place - [0, 0, self.radius - self.fraction * self.depth]
        distance = np.linalg.norm(offset, axis=-1)
        overlap = np.maximum(self.radius - distance, 0)
        self.touched = np.hypot(place[..., 0], place[..., 1])[overlap > 0].max(initial=0.0)
        return overlap, offset / distance[..., None]

    def force(self):
        overlap, normal = self.overlap()
        out = np.zeros_like(self.points)
        np.add.at(
            out, self.cells, np.einsum("qc,qci,aqc->cai", PENALTY * overlap * self.area, normal, self.h)
        )
        return out.ravel()

    def stiffness(self):
        overlap, normal = self.overlap()
        weight = PENALTY * self.area * (overlap > 0)
        local = np.einsum("qc,qci,qcj,aqc,bqc->caibj", weight, normal, normal, self.h, self.h, optimize=True)
        places = (3 * self.cells[..., None] + np.arange(3)).reshape(len(self.cells), -1)
        n = places.shape[1]
        rows, columns = np.repeat(places, n, axis=1).ravel(), np.tile(places, (1, n)).ravel()
        return sp.csr_matrix((local.ravel(), (rows, columns)), shape=(self.points.size,) * 2)


def grade_steps(end, count, first):
    """Coordinates (count + 1,) from 0 to `end` in growing steps, the first about `first`."""
    steps = np.geomspace(first, first * 8, count)
    return np.append(0, np.cumsum(steps) * end / steps.sum())


def space_steps(end, size):
    """Coordinates from 0 to `end` whose steps follow `size(x)`, and are no longer."""
    x = np.linspace(0, end, 4001)
    count = np.append(0, np.cumsum(np.diff(x) / size(0.5 * (x[1:] + x[:-1]))))
    return np.interp(np.linspace(0, count[-1], int(np.ceil(count[-1])) + 1), count, x)


def edge_lines(radius, half, depth, fine):
    """Lines along x and y, and along z, finest at the disc's border: `fine` elements to its radius there."""
    first = radius / fine

    def side(x):
        return first * (1 + 3 * np.maximum(x / radius - 1.15, 0) + 1.5 * np.maximum(0.55 - x / radius, 0))

    return space_steps(half, side), -space_steps(depth, lambda z: first * (1 + 2.5 * z / radius))[::-1]


def opening_lines(half, depth, fine):
    """Lines along x and y, and along z; `fine`: elements from middle to side."""
    return grade_steps(half, fine, 1.0), -grade_steps(depth, fine - 1, 1.2)[::-1]


def solve(poisson, alpha, make_contact, travel_mm, half, depth, opening, lines):
    """Nodes (N, 3), displacement (N, 3) mm, reaction (3,) mN and what presses; `lines`: of the grid, above;
    `make_contact`: from field and mesh."""
    side, z = lines
    x, y = np.append(-side[:0:-1], side), side
    mesh = fem.mesh.add_midpoints_edges(fem.mesh.Grid(x, y, np.unique(z)))
    region = fem.RegionQuadraticHexahedron(mesh)
    field = fem.FieldContainer([fem.Field(region, dim=3)])
    p = mesh.points
    fixed = (
        (np.abs(np.abs(p[:, 0]) - half) < 1e-9) | (np.abs(p[:, 1] - half) < 1e-9) | (p[:, 2] < 1e-9 - depth)
    )
    fixed |= (p[:, 2] > -1e-9) & (np.hypot(p[:, 0], p[:, 1]) > opening)
    bounds = {
        "held": fem.Boundary(field[0], mask=fixed),
        "middle": fem.Boundary(field[0], mask=np.abs(p[:, 1]) < 1e-9, skip=(1, 0, 1)),
    }
    mu, lam = lame(poisson)
    body = fem.SolidBody(Hyperelastic(energy, mu=mu, lam=lam, alpha=alpha), field)
    contact = make_contact(field, mesh)
    dof0, dof1 = fem.dof.partition(field, bounds)
    steps = int(np.ceil(travel_mm))
    for k in range(steps):
        contact.fraction = (k + 1) / steps
        for _ in range(30):
            force = body.assemble.vector(field) - sp.csr_matrix(contact.force()[:, None])
            stiff = body.assemble.matrix(field) + contact.stiffness()
            system = fem.solve.partition(field, stiff, dof1, dof0, force)
            du = fem.solve.solve(*system, solver=pypardiso.spsolve)
            field += du
            # The error that is left is of the order of the step's square.
            if np.linalg.norm(du) < 1e-5 * np.linalg.norm(field[0].values):
                break
        else:
            raise SystemExit("no convergence")
    reaction = 2 * contact.force().reshape(-1, 3).sum(axis=0) * [1, 0, 1]  # by symmetry
    print(region.mesh.ncells, poisson, alpha, travel_mm, reaction, flush=True)
    return p, field[0].values, reaction, contact


def drive(poisson, alpha, radius, travel, middle, *block):
    """As `solve`, without what presses, of a disc that is driven."""
    make_contact = partial(Layer, radius=radius, travel=travel, middle=middle)
    return solve(poisson, alpha, make_contact, np.linalg.norm(travel), *block)[:3]


def ball(poisson, alpha, radius, depth):
    make_contact = partial(Ball, radius=radius, depth=depth)
    lines = edge_lines(np.sqrt(radius * depth), 20.0, 20.0, 5)
    p, u, reaction, contact = solve(poisson, alpha, make_contact, 2 * depth, 20.0, 20.0, np.inf, lines)
    line_nodes = (p[:, 2] > -1e-9) & (np.abs(p[:, 1]) < 1e-9) & (p[:, 0] > -1e-9) & (p[:, 0] < 12)
    return {
        "poisson": poisson,
        "alpha": alpha,
        "radius": radius,
        "depth": depth,
        "touched": round(float(contact.touched), 3),
        "reaction": reaction.round(4).tolist(),
        "places": p[line_nodes, 0].round(4).tolist(),  # along x
        "displacement": u[line_nodes].round(5).tolist(),
    }


def scene(poisson, alpha, radius, travel, fine):
    lines = edge_lines(radius, 20.0, 20.0, fine)
    p, u, reaction = drive(poisson, alpha, radius, travel, 0.0, 20.0, 20.0, np.inf, lines)
    nodes = [int(np.abs(p - [x, y, 0]).sum(axis=1).argmin()) for x, y in PLACES]
    return {
        "poisson": poisson,
        "alpha": alpha,
        "radius": radius,
        "way": travel,
        "reaction": reaction.round(4).tolist(),
        "places": p[nodes].round(4).tolist(),
        "displacement": u[nodes].round(5).tolist(),
    }


def opening(poisson, alpha, radius, travel, middle, fine):
    lines = opening_lines(30.0, 40.0, fine)
    p, u, reaction = drive(poisson, alpha, radius, travel, middle, 30.0, 40.0, OPENING, lines)
    top_nodes = (p[:, 2] > -1e-9) & (np.hypot(p[:, 0], p[:, 1]) < OPENING + 4)
    return {
        "poisson": poisson,
        "alpha": alpha,
        "reaction": reaction.tolist(),
        "places": p[top_nodes, :2].round(4).tolist(),  # of the half with y >= 0
        "displacement": u[top_nodes].round(5).tolist(),
    }


if __name__ == "__main__":
    answer = {
        "felupe": fem.__version__,
        "points": points(),
        "scenes": [scene(*case, 6 if case[2] > 6 else 5) for case in SCENES],
        "balls": [ball(*case) for case in BALLS],
        "openings": [opening(*case, 6) for case in OPENINGS],
    }
    Path(__file__).with_suffix(".json").write_text(json.dumps(answer))
