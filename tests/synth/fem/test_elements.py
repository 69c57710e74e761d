"""Elements and laws against scikit-fem, closed forms and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
import skfem
from skfem.models.elasticity import lame_parameters, linear_elasticity

from synth.errors import UserError
from synth.fem.assembly import gradient, stiffness
from synth.fem.laws import NUMBER, lame, stress, tangent
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.element import quadrature, quality
from synth.fem.mesh.refine import bisect, refine
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.system import POINTWISE, System, assemble, hooke
from synth.job import schema

LAWS = sorted(NUMBER)


def cube(order: int, n: int = 3) -> Tets:
    """A unit cube of tetrahedra whose inner corners are shaken, all its boundary fixed, no springs."""
    grid = skfem.MeshTet.init_tensor(*[np.linspace(0, 1, n + 1)] * 3)
    points, cells = grid.p.T.copy(), grid.t.T.astype(np.int64)
    inside = ((points > 0) & (points < 1)).all(axis=1)
    points[inside] += np.random.default_rng(1).uniform(-0.06, 0.06, (inside.sum(), 3))
    corner = points[cells]
    flipped = np.linalg.det(corner[:, 1:] - corner[:, :1]) < 0
    cells[flipped] = cells[flipped][:, [0, 2, 1, 3]]
    points, cells = tetrahedra.lengthened(points, cells, order)
    edge = ((points < 1e-9) | (points > 1 - 1e-9)).any(axis=1)
    return Tets(points, cells, order, edge, sp.csr_array((len(points), len(points))))


@pytest.mark.parametrize("order", [1, 2])
def test_stiffness_is_scikit_fems(order: int) -> None:
    tets = cube(order)
    ours = stiffness(quadrature(tets.points, tets.cells, order), hooke(2.0, 0.4))
    grid = skfem.MeshTet(tets.points[: tets.cells[:, :4].max() + 1].T, tets.cells[:, :4].T)
    element = skfem.ElementVector(skfem.ElementTetP1() if order == 1 else skfem.ElementTetP2())
    basis = skfem.Basis(grid, element, intorder=2 * order)
    theirs = linear_elasticity(*lame_parameters(2.0, 0.4)).assemble(basis)
    # Both number nodes in their own way: match them by where they are.
    place = basis.doflocs[:, ::3].T
    same = np.lexsort(np.round(place, 9).T)[np.argsort(np.lexsort(np.round(tets.points, 9).T))]
    np.testing.assert_allclose(place[same], tets.points, atol=1e-12)
    dof = (3 * same[:, None] + np.arange(3)).ravel()
    error = abs(ours - sp.csr_array(theirs)[dof][:, dof]).max()
    assert error <= 1e-12 * abs(ours).max()


@pytest.mark.parametrize("averaged", [False, True])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("order", [1, 2])
def test_patch(averaged: bool, law: str, order: int) -> None:
    """Under a uniform strain on the boundary, the inside follows it: forces at inner nodes vanish."""
    tets = cube(order)
    system = assemble(tets, law, 0.4, averaged=averaged)
    strain = np.array([[0.05, 0.02, -0.03], [0.01, -0.04, 0.02], [0.03, 0.0, 0.06]])
    force = system.state(tets.points @ strain.T).force
    assert np.abs(force[~tets.fixed]).max() <= 1e-12 * np.abs(force).max()


@pytest.mark.parametrize("order", [1, 2])
def test_linear_solution_with_prescribed_boundary_is_the_uniform_strain(order: int) -> None:
    tets = cube(order)
    system = assemble(tets, "linear", 0.4)
    strain = np.array([[0.05, 0.02, -0.03], [0.01, -0.04, 0.02], [0.03, 0.0, 0.06]])
    exact = tets.points @ strain.T
    shell = np.where(tets.fixed[:, None], exact, 0.0)
    inner = system.solve(-system.state(shell).force)
    assert np.abs(shell + inner - exact).max() <= 1e-12


@pytest.mark.parametrize("averaged", [False, True])
@pytest.mark.parametrize("law", [name for name in LAWS if name != "linear"])
def test_rigid_rotation_gives_no_force(averaged: bool, law: str) -> None:
    system = assemble(cube(2), law, 0.4, averaged=averaged)
    points = cube(2).points
    turn, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    state = system.state(points @ turn.T - points + 3.0)
    assert np.abs(state.force).max() <= 1e-13
    assert abs(state.energy) <= 1e-13
    assert state.jacobian == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("averaged", [False, True])
@pytest.mark.parametrize("law", LAWS)
def test_force_is_the_slope_of_the_energy(averaged: bool, law: str) -> None:
    system, rng = assemble(cube(2), law, 0.4, averaged=averaged), np.random.default_rng(3)
    u, step = 0.004 * rng.normal(size=(system.mesh.nodes, 3)), rng.normal(size=(system.mesh.nodes, 3))
    h = 2e-6
    slope = (system.state(u + h * step).energy - system.state(u - h * step).energy) / (2 * h)
    assert slope == pytest.approx(float(np.vdot(system.state(u).force, step)), rel=1e-7)


@pytest.mark.parametrize("law", LAWS)
def test_tangent_is_the_slope_of_the_stress(law: str) -> None:
    rng, h = np.random.default_rng(5), 1e-5
    strain = 0.25 * rng.normal(size=(40, 3, 3))
    strain = strain[np.linalg.det(strain + np.eye(3)) > 0.3]
    moduli = np.empty((len(strain), 3, 3, 3, 3))
    tangent(NUMBER[law], strain, 0.7, 1.9, moduli)
    up, down, energy = np.empty_like(strain), np.empty_like(strain), np.empty(len(strain))
    for k in range(3):
        for m in range(3):
            step = np.zeros((3, 3))
            step[k, m] = h
            stress(NUMBER[law], strain + step, 0.7, 1.9, up, energy)
            stress(NUMBER[law], strain - step, 0.7, 1.9, down, energy)
            error = np.abs((up - down) / (2 * h) - moduli[:, :, :, k, m]).max(axis=(1, 2))
            assert (error <= 1e-7 * np.abs(moduli).max(axis=(1, 2, 3, 4))).all()


@pytest.mark.parametrize("averaged", [False, True])
@pytest.mark.parametrize("law", LAWS)
def test_every_law_is_hookes_at_rest(averaged: bool, law: str) -> None:
    system, rng = assemble(cube(2), law, 0.45, averaged=averaged), np.random.default_rng(4)
    u = rng.normal(size=(system.mesh.nodes, 3))
    h = 1e-6
    tangent = (system.state(h * u).force - system.state(-h * u).force) / (2 * h)
    hooke = (system.stiffness @ u.ravel()).reshape(-1, 3)
    assert np.abs(tangent - hooke).max() <= 1e-7 * np.abs(hooke).max()


@pytest.mark.parametrize("averaged", [False, True])
@pytest.mark.parametrize("law", LAWS)
def test_stiffness_at_a_state_is_the_slope_of_the_force(averaged: bool, law: str) -> None:
    system, rng, h = assemble(cube(2), law, 0.47, averaged=averaged), np.random.default_rng(6), 1e-6
    assert (system.averaged > 0) == averaged
    u, step = 0.004 * rng.normal(size=(system.mesh.nodes, 3)), rng.normal(size=(system.mesh.nodes, 3))
    slope = (system.state(u + h * step).force - system.state(u - h * step).force) / (2 * h)
    found = (system.tangent(u) @ step.ravel()).reshape(-1, 3)
    assert np.abs(found - slope).max() <= 1e-5 * np.abs(slope).max()


def test_mean_swelling_is_resisted_by_lambda_and_the_rest_by_its_part_at_points() -> None:
    """Even swelling costs the same both ways; what varies within an element only what acts at points."""
    tets, poisson = cube(2), 0.49
    mu, lam = lame(1.0, poisson)
    plain, mean = (assemble(tets, "linear", poisson, averaged=one) for one in (False, True))
    even = 0.01 * tets.points
    assert mean.state(even).energy == pytest.approx(plain.state(even).energy, rel=1e-12)
    u = 0.01 * np.random.default_rng(7).normal(size=tets.points.shape)
    strain = np.empty((plain.mesh.weight.size, 3, 3))
    gradient(plain.mesh.cells, plain.mesh.slope, u, strain)
    weight = plain.mesh.weight
    swelling = np.trace(strain, axis1=1, axis2=2).reshape(weight.shape)
    whole = (swelling * weight).sum(axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
    saved = 0.5 * (lam - POINTWISE * mu) * float((weight * (swelling**2 - whole**2)).sum())
    assert plain.state(u).energy - mean.state(u).energy == pytest.approx(saved, rel=1e-9)


def test_bisection_conforms_and_keeps_volume_and_orientation() -> None:
    points, cells = tetrahedra._bricks(np.array([100.0, 100.0, 60.0]), 16)
    volume = _volumes(points, cells).sum()
    for seed in range(4):
        chosen = np.random.default_rng(seed).choice(len(cells), 5, replace=False)
        points, cells = bisect(points, cells, chosen)
    assert _volumes(points, cells).min() > 0
    assert _volumes(points, cells).sum() == pytest.approx(volume, rel=1e-12)
    faces = np.sort(cells[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    unique, count = np.unique(faces, axis=0, return_counts=True)
    assert count.max() == 2
    middle = points[unique[count == 1]].mean(axis=1)
    on_edge = (np.abs(np.abs(middle[:, :2]) - 50) < 1e-9).any(axis=1)
    on_edge |= (np.abs(middle[:, 2]) < 1e-9) | (np.abs(middle[:, 2] + 60) < 1e-9)
    assert on_edge.all()  # a hanging corner would leave lone faces inside


@pytest.mark.parametrize("tets", [300, 1600, 4000])
def test_block_has_the_wanted_size_and_sound_tetrahedra(tets: int) -> None:
    block = tetrahedra.block(schema.Anatomy(), tets, 1)
    assert tets <= len(block.cells) <= 1.3 * tets + 150
    assert quality(block.points[block.cells]).min() > 0.2


def test_quality_is_1_for_a_regular_and_0_for_a_flat_tetrahedron() -> None:
    regular = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    assert abs(quality(regular[None])[0]) == pytest.approx(1.0)
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1e-9]])
    assert quality(flat[None])[0] == pytest.approx(0.0, abs=1e-5)


def test_a_flat_element_is_refused() -> None:
    tets = cube(1)
    points = tets.points.copy()
    inner, cell = next((v, c) for c in tets.cells for v in c if not tets.fixed[v])
    base = points[cell[cell != inner]].mean(axis=0)
    points[inner] = base + 1e-6 * (points[inner] - base)
    with pytest.raises(UserError, match=r"element \d+ is flat"):
        assemble(replace(tets, points=points), "linear", 0.4)


def test_refining_is_finest_where_size_is_smallest() -> None:
    points, cells = tetrahedra._bricks(np.array([100.0, 100.0, 60.0]), 16)
    points, cells = refine(points, cells, lambda at: 1 + np.linalg.norm(at, axis=1), 2000)
    centre = np.linalg.norm(points[cells].mean(axis=1), axis=1)
    volume = _volumes(points, cells)
    assert volume[centre < 10].mean() < 0.01 * volume[centre > 45].mean()


def _volumes(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    corner = points[cells[:, :4]]
    return np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6


def test_system_is_of_use_for_all_stiffnesses() -> None:
    """Displacement depends on force over E alone, so one factorisation serves every E."""
    tets = tetrahedra.block(schema.Anatomy(), 300, 1)
    soft: System = assemble(tets, "linear", 0.4)
    force = np.zeros((len(tets.points), 3))
    force[np.argmax(tets.points[:, 2])] = (0.3, -0.2, 1.0)
    assert np.abs(soft.stiffness @ soft.solve(force).ravel() - force.ravel())[soft.free].max() < 1e-11
