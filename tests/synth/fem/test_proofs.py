"""The solver against closed forms: half-space, uniaxial stretch, manufactured solutions, Newton's method."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from dome import patch
from newton import newton
from scipy.optimize import brentq
from scipy.sparse.linalg import splu
from skfem.quadrature import get_quadrature
from skfem.refdom import RefTet

from synth.fem import equilibrium, surface_embedding, tool_gesture
from synth.fem.law_choice import LEAST_JACOBIAN
from synth.fem.laws import lame
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.element import bary_slope, shape
from synth.fem.mesh.refine import refine
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.system import System, assemble

Floats = np.ndarray


def box(points: Floats, cells: Floats, size: tuple[float, float, float]) -> Tets:
    """A box from z = -depth to 0, fixed on all sides but the top, without springs."""
    points, cells = tetrahedra.with_midsides(points, cells)
    half = np.array(size)[:2] / 2
    fixed = (np.abs(np.abs(points[:, :2]) - half) < 1e-9).any(axis=1) | (points[:, 2] < 1e-9 - size[2])
    return Tets(points, cells, fixed, sp.csr_array((len(points), len(points))))


def cubes(size: tuple[float, float, float], count: float) -> Tets:
    return box(*tetrahedra.bricks(np.array(size), count), size)


def boussinesq(points: Floats, young: float, poisson: float) -> Floats:
    """Displacement of a half-space z <= 0 under a unit force in -z at the origin (Johnson 1985, 3.2)."""
    shear = young / (2 * (1 + poisson))
    radius, depth = np.hypot(points[:, 0], points[:, 1]), -points[:, 2]
    distance = np.sqrt(radius**2 + depth**2)
    down = (2 * (1 - poisson) / distance + depth**2 / distance**3) / (4 * np.pi * shear)
    out = (depth / distance**3 - (1 - 2 * poisson) / (distance * (distance + depth))) / (4 * np.pi * shear)
    return np.column_stack([out * points[:, 0], out * points[:, 1], -down])


@pytest.mark.parametrize("poisson", [0.4, 0.49])
def test_kernel_on_a_half_space(poisson: float) -> None:
    """w0 = 1.0186 (1 - nu^2) F / (a E) under (1 - (r/a)^2)^2; the far boundary carries the solution."""
    a, size = 1.0, (4.0, 4.0, 2.0)
    points, cells = tetrahedra.bricks(np.array(size), 20)
    points, cells = refine(points, cells, lambda x: 0.25 + np.linalg.norm(x, axis=1), 2000)
    tets = box(points, cells, size)
    # The kernel as 24 rings of 24 point forces each.
    node, weight = np.polynomial.legendre.leggauss(24)
    r, angle = a * (node + 1) / 2, 2 * np.pi * np.arange(24) / 24
    ring = weight * a / 2 * r * (1 - (r / a) ** 2) ** 2 * 3 / (np.pi * a**2) * 2 * np.pi / 24
    edge = np.flatnonzero(tets.fixed)
    shell = np.zeros_like(tets.points)
    for radius, share in zip(r, ring, strict=True):
        for turn in angle:
            offset = np.array([radius * np.cos(turn), radius * np.sin(turn), 0.0])
            shell[edge] += share * boussinesq(tets.points[edge] - offset, 1.0, poisson)
    system = assemble(tets, "linear", poisson)
    n = 121
    vertices, faces = patch(n, 2.4)
    vertices[:, 2] = 0
    area = surface_embedding.vertex_area(vertices, faces)
    kernel = tool_gesture.footprint(np.zeros(2), a, vertices, area)
    embedding = surface_embedding.embed(tets, vertices)
    load = embedding.gather(np.outer(area * kernel, [0, 0, -1.0]))
    u = shell + system.solve(load - (system.stiffness @ shell.ravel()).reshape(-1, 3))
    centre = -embedding.move(u)[n * n // 2, 2]
    assert centre == pytest.approx(1.0186 * (1 - poisson**2) / a, rel=0.005 if poisson < 0.45 else 0.01)


def test_uniaxial_neo_hookean() -> None:
    """A cube pulled to stretch 1.5 with free sides: stress and sideways stretch from one scalar equation."""
    tets, poisson, stretch = cubes((2.0, 2.0, 2.0), 8), 0.4, 1.5
    system = assemble(tets, "neo-hookean", poisson)
    points = tets.points + np.array([1.0, 1.0, 2.0])
    fixed_dofs = points < 1e-9
    fixed_dofs[:, 2] |= points[:, 2] > 2 - 1e-9
    free = np.flatnonzero(~fixed_dofs.ravel())
    system = replace(system, free=free, factor=splu(system.stiffness[free][:, free].tocsc()))
    start = points * [stretch**-0.4 - 1, stretch**-0.4 - 1, stretch - 1]
    u = newton(system, np.zeros_like(start), start, tolerance=1e-13)
    mu, lam = lame(1.0, poisson)
    side = brentq(lambda t: mu * (t - 1 / t) + lam * np.log(stretch * t * t) / t, 0.5, 1.0, xtol=1e-15)
    pull = mu * (stretch - 1 / stretch) + lam * np.log(stretch * side**2) / stretch
    assert np.abs(u - points * [side - 1, side - 1, stretch - 1]).max() <= 1e-10
    force = system.state(u).force[points[:, 2] > 2 - 1e-9, 2].sum()
    assert force / 4 == pytest.approx(pull, abs=1e-10)


@pytest.mark.slow
def test_manufactured_solution_converges() -> None:
    coarse_error, fine_error = (_measure_error(n) for n in (4, 8))
    assert np.log2(coarse_error / fine_error) == pytest.approx(3.0, abs=0.1)


def _measure_error(n: int) -> float:
    """L2 error of u = (1, 1/2, -1) sin x sin y sin z (times pi, on the unit cube) under its body force."""
    tets = cubes((1.0, 1.0, 1.0), n**3)
    tets = replace(tets, fixed=tets.fixed | (tets.points[:, 2] > -1e-9))
    amplitude, shift, k = np.array([1.0, 0.5, -1.0]), np.array([0.5, 0.5, 1.0]), np.pi
    mu, lam = lame(1.0, 0.0)

    def exact(x: Floats) -> Floats:
        return np.prod(np.sin(k * (x + shift)), axis=-1)[..., None] * amplitude

    def body(x: Floats) -> Floats:
        s, c = np.sin(k * (x + shift)), np.cos(k * (x + shift))
        second = np.empty((*x.shape[:-1], 3, 3))  # of sin sin sin
        for i in range(3):
            for j in range(3):
                rest = [m for m in range(3) if m not in (i, j)]
                factor = c[..., i] * c[..., j] if i != j else -s[..., i]
                second[..., i, j] = k * k * factor * np.prod(s[..., rest], axis=-1)
        return 3 * k * k * mu * exact(x) - (lam + mu) * second @ amplitude

    nodes, weight = get_quadrature(RefTet, 5)
    bary = np.column_stack([1 - nodes.sum(axis=0), nodes.T])
    corner = tets.points[tets.cells[:, :4]]
    volume = bary_slope(corner)[1]
    positions = np.einsum("qc,mcd->mqd", bary, corner)
    value = shape(bary)
    local = np.einsum("m,q,qn,mqd->mnd", 6 * volume, weight, value, body(positions))
    load = np.zeros_like(tets.points)
    np.add.at(load, tets.cells, local)
    system = assemble(tets, "linear", 0.0)
    u = system.solve(load)
    error = np.einsum("qn,mnd->mqd", value, u[tets.cells]) - exact(positions)
    return float(np.sqrt(np.einsum("m,q,mqd->", 6 * volume, weight, error**2)))


def load_block(law: str, load: float, kind: str) -> tuple[System, Floats]:
    """A block under one contact, and the load for E = 1 kPa."""
    tets = tetrahedra.block(700, ((2.0, 1.0, 4.0),))
    vertices, faces = patch()
    area = surface_embedding.vertex_area(vertices, faces)
    kernel = tool_gesture.footprint(np.array([2.0, 1.0]), 4.0, vertices, area) * area
    direction = np.array([0.5, 0.0, 0.87 if kind == "pull" else -0.87])
    force = surface_embedding.embed(tets, vertices).gather(np.outer(kernel, 16.0 * load * direction))
    return assemble(tets, law, 0.4), force


@pytest.mark.slow
@pytest.mark.parametrize(("law", "kind"), [("corotational", "pull"), ("neo-hookean", "push")])
def test_fast_solver_agrees_with_newtons_method(law: str, kind: str) -> None:
    system, load = load_block(law, 0.15, kind)
    fractions = np.array([0.0, 0.4, 0.8, 1.0])
    path = equilibrium.solve_path(system, fractions[:, None, None] * load, 0.15 * fractions)
    exact = newton(system, load, path.displacement[-1], 1e-8)
    assert np.linalg.norm(path.displacement[-1] - exact) <= 1e-3 * np.linalg.norm(exact)


def test_a_corner_that_is_pressed_flat_on_the_surface_is_refused() -> None:
    """No quadrature point is near it."""
    system, load = load_block("corotational", 0.1, "push")
    top = int(np.abs(load).sum(axis=1)[system.mesh.cells[:, :4]].max(axis=1).argmax())
    corner = system.mesh.cells[top, :4][np.abs(load).sum(axis=1)[system.mesh.cells[top, :4]].argmax()]
    u = np.zeros_like(load)
    u[corner, 2] = -1e-3
    u *= 0.9 / (1 - system.least_jacobian(u)[0])  # det F is linear in one node's displacement
    state = system.state(u)
    assert system.least_jacobian(u)[0] == pytest.approx(0.1)
    assert replace(system, corners=system.mesh).least_jacobian(u)[0] > 2 * LEAST_JACOBIAN
    with pytest.raises(equilibrium.InvertedElement):
        equilibrium.check_state(system, u, state, 3, 0.1)
