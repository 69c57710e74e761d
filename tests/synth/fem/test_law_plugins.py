"""Plug-in laws: the same results for the same law, and faulty laws refused."""

from __future__ import annotations

import numpy as np
import pytest
from dome import ANATOMY
from numpy.typing import NDArray

import synth
from synth.fem import foreign_law
from synth.fem.mesh import tetrahedra
from synth.fem.system import assemble

Floats = NDArray[np.float64]


class NeoHookean:
    """Our law, implemented independently."""

    largest_load = 0.4

    def stress(self, f: Floats, mu: float, lam: float) -> tuple[Floats, Floats]:
        log = np.log(np.linalg.det(f))
        turned = np.linalg.inv(f).transpose(0, 2, 1)
        energy = mu / 2 * (np.einsum("nij,nij->n", f, f) - 3) - mu * log + lam / 2 * log**2
        return energy, mu * (f - turned) + (lam * log)[:, None, None] * turned


@pytest.fixture(scope="module")
def own() -> str:
    synth.add_law("test-neo-hookean", NeoHookean())
    return "test-neo-hookean"


def test_the_same_law_gives_the_same_equations(own: str) -> None:
    tets = tetrahedra.block(ANATOMY, 400)
    theirs, ours = (assemble(tets, law, 0.45) for law in (own, "neo-hookean"))
    u = 0.2 * np.random.default_rng(0).normal(size=tets.points.shape)
    one, other = theirs.state(u), ours.state(u)
    assert one.energy == pytest.approx(other.energy, rel=1e-10)
    assert one.jacobian == pytest.approx(other.jacobian, rel=1e-10)
    np.testing.assert_allclose(one.force, other.force, atol=1e-9 * np.abs(other.force).max())


def faulty(change: str) -> type[NeoHookean]:
    class Faulty(NeoHookean):
        def stress(self, f: Floats, mu: float, lam: float) -> tuple[Floats, Floats]:
            energy, first = super().stress(f, mu, lam)
            log = np.log(np.linalg.det(f))
            if change == "slope":
                first = first + 0.01 * mu * (f - np.eye(3)) * log[:, None, None]
            if change == "rest":
                energy, first = energy + 0.01 * np.trace(f, axis1=1, axis2=2), first + 0.01 * np.eye(3)
            if change == "turn":
                energy, first = energy + (f[:, 0, 1] ** 4), first.copy()
                first[:, 0, 1] += 4 * f[:, 0, 1] ** 3
            return energy, first

    return Faulty


@pytest.mark.parametrize("change", ["slope", "rest", "turn"])
def test_a_law_that_would_be_silently_wrong_is_refused(change: str) -> None:
    foreign_law.check_law(NeoHookean())
    with pytest.raises(synth.UserError):
        foreign_law.check_law(faulty(change)())
