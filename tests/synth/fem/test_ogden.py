"""Ogden's law against felupe and finite differences; see `evidence/fem/felupe_ogden.py`."""

import numpy as np
import pytest
from shaken_cube import cube

from evidence.fem.solvers import FELUPE
from synth.fem import ogden
from synth.fem.laws import lame
from synth.fem.system import assemble, hooke
from synth.fem.tangent import linearise


def stress(f: np.ndarray, poisson: float, alpha: float) -> tuple[np.ndarray, np.ndarray]:
    first_pk, energy = np.empty_like(f), np.empty(len(f))
    ogden.stress(f - np.eye(3), *lame(1.0, poisson), alpha, first_pk, energy)
    return first_pk, energy


@pytest.mark.parametrize("row", FELUPE["points"], ids=lambda row: f"alpha {row['alpha']:g}")
def test_stress_and_tangent_are_felupes(row: dict) -> None:  # type: ignore[type-arg]
    f = np.array(row["f"])
    first_pk, _ = stress(f, row["poisson"], row["alpha"])
    np.testing.assert_allclose(first_pk, row["stress"], atol=1e-6 * np.abs(first_pk).max())
    tangent = ogden.tangent(f - np.eye(3), *lame(1.0, row["poisson"]), row["alpha"])
    np.testing.assert_allclose(tangent, row["tangent"], atol=1e-5 * np.abs(tangent).max())


@pytest.mark.parametrize("alpha", [-20.0, -4.7, 2.0])
def test_tangent_is_the_slope_of_stress_and_stress_that_of_energy(alpha: float) -> None:
    rng = np.random.default_rng(3)
    f = np.eye(3) + 0.2 * rng.uniform(-1, 1, (20, 3, 3))
    f[0], f[1] = np.eye(3), np.diag([1.1, 1.1, 0.8])  # equal stretches
    direction, h = rng.normal(size=f.shape), 1e-6
    (upper_stress, upper_energy), (lower_stress, lower_energy) = (
        stress(f + side * h * direction, 0.45, alpha) for side in (1, -1)
    )
    first_pk, _ = stress(f, 0.45, alpha)
    slope = np.einsum("nij,nij->n", first_pk, direction)
    np.testing.assert_allclose(
        (upper_energy - lower_energy) / (2 * h), slope, atol=1e-7 * np.abs(slope).max()
    )
    rate = np.einsum("nijkm,nkm->nij", ogden.tangent(f - np.eye(3), *lame(1.0, 0.45), alpha), direction)
    np.testing.assert_allclose((upper_stress - lower_stress) / (2 * h), rate, atol=1e-7 * np.abs(rate).max())
    positive_tangent = ogden.tangent(f - np.eye(3), *lame(1.0, 0.45), alpha, positive=True).reshape(-1, 9, 9)
    assert np.linalg.eigvalsh(positive_tangent).min() >= -1e-9 * np.abs(positive_tangent).max()
    rest_tangent = ogden.tangent(np.zeros((1, 3, 3)), *lame(1.0, 0.45), alpha)
    np.testing.assert_allclose(rest_tangent, hooke(1.0, 0.45), atol=1e-12)


def test_inside_out_tissue_has_infinite_energy() -> None:
    first_pk, energy = stress(np.diag([1.0, 1.0, -0.5])[None], 0.45, -4.7)
    assert np.isinf(energy).all()
    assert not first_pk.any()


@pytest.mark.parametrize("law", ["ogden", "neo-hookean"])
def test_stiffness_at_a_deformed_state_is_the_slope_of_force(law: str) -> None:
    tets = cube()
    system, rng, h = assemble(tets, law, 0.45, alpha=-8.0), np.random.default_rng(3), 1e-6
    u, step = 0.001 * rng.normal(size=(system.mesh.nodes, 3)), rng.normal(size=(system.mesh.nodes, 3))
    slope = (system.state(u + h * step).force - system.state(u - h * step).force) / (2 * h)
    derivative = (linearise(system, u).stiffness @ step.ravel()).reshape(-1, 3)
    # Curvature that is negative is cut off, which is little at such strains.
    assert np.abs(derivative - slope).max() <= 0.01 * np.abs(slope).max()
