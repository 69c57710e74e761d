"""Elements and laws, ours and plug-ins, against scikit-fem, closed forms and finite differences."""

import numpy as np
import pytest
import scipy.sparse as sp
import skfem
from numpy.typing import NDArray
from shaken_cube import cube
from skfem.models.elasticity import lame_parameters, linear_elasticity

import synth
from synth.fem import foreign_law
from synth.fem.assembly import stiffness
from synth.fem.laws import NUMBER
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.element import bary_slope, quadrature
from synth.fem.mesh.refine import bisect
from synth.fem.system import assemble, hooke

LAWS = sorted(NUMBER)


def test_stiffness_is_scikit_fems() -> None:
    tets = cube()
    matrix = stiffness(quadrature(tets.points, tets.cells), hooke(2.0, 0.4))
    grid = skfem.MeshTet(tets.points[: tets.cells[:, :4].max() + 1].T, tets.cells[:, :4].T)
    element = skfem.ElementVector(skfem.ElementTetP2())
    basis = skfem.Basis(grid, element, intorder=4)
    reference = linear_elasticity(*lame_parameters(2.0, 0.4)).assemble(basis)
    # Both number nodes in their own way: match them by where they are.
    positions = basis.doflocs[:, ::3].T
    permutation = np.lexsort(np.round(positions, 9).T)[np.argsort(np.lexsort(np.round(tets.points, 9).T))]
    np.testing.assert_allclose(positions[permutation], tets.points, atol=1e-12)
    dof = (3 * permutation[:, None] + np.arange(3)).ravel()
    error = abs(matrix - sp.csr_array(reference)[dof][:, dof]).max()
    assert error <= 1e-12 * abs(matrix).max()


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_stress_at_nodes_is_that_of_a_uniform_strain(law: str) -> None:
    tets, (mu, lam), identity = cube(), lame_parameters(1.0, 0.4)[::-1], np.eye(3)
    strain = np.array([[0.05, 0.02, -0.03], [0.01, -0.04, 0.02], [0.03, 0.0, 0.06]])
    f = identity + strain
    j = np.linalg.det(f)
    expected = mu * (strain + strain.T) + lam * np.trace(strain) * identity
    if law == "neo-hookean":
        expected = (mu * (f @ f.T - identity) + lam * np.log(j) * identity) / j
    stress = assemble(tets, law, 0.4).cauchy(tets.points @ strain.T)
    np.testing.assert_allclose(
        stress, np.tile(expected[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]], (len(stress), 1)), atol=1e-12
    )


@pytest.mark.parametrize("law", LAWS)
def test_patch(law: str) -> None:
    """Under a uniform strain on the boundary, the inside follows it: forces at inner nodes vanish."""
    tets = cube()
    system = assemble(tets, law, 0.4)
    strain = np.array([[0.05, 0.02, -0.03], [0.01, -0.04, 0.02], [0.03, 0.0, 0.06]])
    force = system.state(tets.points @ strain.T).force
    assert np.abs(force[~tets.fixed]).max() <= 1e-12 * np.abs(force).max()


@pytest.mark.parametrize("law", [name for name in LAWS if name != "linear"])
def test_rigid_rotation_gives_no_force(law: str) -> None:
    system = assemble(cube(), law, 0.4)
    points = cube().points
    turn, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    displacement = points @ turn.T - points + 3.0
    state = system.state(displacement)
    assert np.abs(state.force).max() <= 1e-13
    assert abs(state.energy) <= 1e-13
    assert system.least_jacobian(displacement)[0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("poisson", [0.2, 0.47])
@pytest.mark.parametrize("law", LAWS)
def test_force_is_the_slope_of_energy_and_stiffness_that_of_force_at_rest(poisson: float, law: str) -> None:
    system, rng, h = assemble(cube(), law, poisson), np.random.default_rng(3), 1e-6
    assert (system.averaged > 0) == (poisson > 0.25)  # where lambda is over mu
    u, step = 0.004 * rng.normal(size=(system.mesh.nodes, 3)), rng.normal(size=(system.mesh.nodes, 3))
    slope = (system.state(u + h * step).energy - system.state(u - h * step).energy) / (2 * h)
    assert slope == pytest.approx(float(np.vdot(system.state(u).force, step)), rel=1e-6)
    slope = (system.state(h * step).force - system.state(-h * step).force) / (2 * h)
    derivative = (system.stiffness @ step.ravel()).reshape(-1, 3)  # Hooke's, of every law
    assert np.abs(derivative - slope).max() <= 1e-5 * np.abs(slope).max()


def test_bisection_conforms_and_keeps_volume_and_orientation() -> None:
    points, cells = tetrahedra.bricks(np.array([100.0, 100.0, 60.0]), 16)
    for seed in range(4):
        marked_cells = np.random.default_rng(seed).choice(len(cells), 5, replace=False)
        points, cells = bisect(points, cells, marked_cells)
    volumes = bary_slope(points[cells])[1]
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(100 * 100 * 60, rel=1e-12)
    faces = np.sort(cells[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    unique, count = np.unique(faces, axis=0, return_counts=True)
    assert count.max() == 2
    centres = points[unique[count == 1]].mean(axis=1)
    on_edge = (np.abs(np.abs(centres[:, :2]) - 50) < 1e-9).any(axis=1)
    on_edge |= (np.abs(centres[:, 2]) < 1e-9) | (np.abs(centres[:, 2] + 60) < 1e-9)
    assert on_edge.all()  # a hanging corner would leave lone faces inside


Floats = NDArray[np.float64]


class NeoHookean:
    """Our law, implemented independently."""

    largest_load = 0.4

    def stress(self, f: Floats, mu: float, lam: float) -> tuple[Floats, Floats]:
        log = np.log(np.linalg.det(f))
        inverse_transpose = np.linalg.inv(f).transpose(0, 2, 1)
        energy = mu / 2 * (np.einsum("nij,nij->n", f, f) - 3) - mu * log + lam / 2 * log**2
        return energy, mu * (f - inverse_transpose) + (lam * log)[:, None, None] * inverse_transpose


@pytest.fixture(scope="module")
def foreign_law_name() -> str:
    synth.add_law("test-neo-hookean", NeoHookean())
    return "test-neo-hookean"


def test_the_same_law_gives_the_same_equations(foreign_law_name: str) -> None:
    tets = tetrahedra.block(400)
    foreign_system, system = (assemble(tets, law, 0.45) for law in (foreign_law_name, "neo-hookean"))
    u = 0.2 * np.random.default_rng(0).normal(size=tets.points.shape)
    foreign_state, state = foreign_system.state(u), system.state(u)
    assert foreign_state.energy == pytest.approx(state.energy, rel=1e-10)
    np.testing.assert_allclose(foreign_state.force, state.force, atol=1e-9 * np.abs(state.force).max())


def make_faulty(change: str) -> type[NeoHookean]:
    class Faulty(NeoHookean):
        def stress(self, f: Floats, mu: float, lam: float) -> tuple[Floats, Floats]:
            energy, first_pk = super().stress(f, mu, lam)
            log = np.log(np.linalg.det(f))
            if change == "slope":
                first_pk = first_pk + 0.01 * mu * (f - np.eye(3)) * log[:, None, None]
            if change == "rest":
                energy, first_pk = energy + 0.01 * np.trace(f, axis1=1, axis2=2), first_pk + 0.01 * np.eye(3)
            if change == "turn":
                energy, first_pk = energy + (f[:, 0, 1] ** 4), first_pk.copy()
                first_pk[:, 0, 1] += 4 * f[:, 0, 1] ** 3
            return energy, first_pk

    return Faulty


@pytest.mark.parametrize("change", ["slope", "rest", "turn"])
def test_a_law_that_would_be_silently_wrong_is_refused(change: str) -> None:
    foreign_law.check_law(NeoHookean())
    with pytest.raises(synth.UserError):
        foreign_law.check_law(make_faulty(change)())
