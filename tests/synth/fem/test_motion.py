"""Inertia and relaxation against closed forms and the equations they step."""

import numpy as np
import pytest
import scipy.sparse as sp

from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.motion import Clock, march_in_time, nodal_mass
from synth.fem.system import assemble


def cube() -> Tets:
    """A cube of 10 mm on a fixed floor."""
    points, cells = tetrahedra.with_midsides(*tetrahedra._bricks(np.array([10.0, 10.0, 10.0]), 8))
    return Tets(points, cells, points[:, 2] < -10 + 1e-9, sp.csr_array((len(points),) * 2))


def pulled(tets: Tets, load: float) -> np.ndarray:
    """An even pull on the top, (N, 3) mN."""
    top = tets.points[:, 2] > -1e-9
    return np.outer(top / top.sum(), [0.3, 0.0, load])


def test_creep_under_a_held_load_is_the_closed_form() -> None:
    """J(t) = 1/g - (1/g - 1) exp(-g t / tau), g the part of the stiffness that stays."""
    tets, lost, tau = cube(), 0.4, 0.5
    stays, load, frames = 1 - lost, pulled(tets, 1.0), 41
    loads = np.repeat(load[None], frames, axis=0)
    loads[0] = 0
    clock = Clock(step_s=0.02, relaxation=((lost, tau),))
    path = march_in_time(tets, Tissue(1.0, 0.4, "linear"), loads, np.full(frames, 0.1), clock)
    sudden = assemble(tets, "linear", 0.4).solve(load)
    grown = np.einsum("tnd,nd->t", path.displacement, sudden) / np.vdot(sudden, sudden)
    since = 0.02 * np.arange(frames) - 0.01  # the load comes on evenly within the first step
    exact = 1 / stays - (1 / stays - 1) * np.exp(-stays * since / tau)
    np.testing.assert_allclose(grown[2:], exact[2:], rtol=1e-3)


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_a_step_keeps_the_balance_of_momentum(law: str) -> None:
    tets, frames, dt, damping = cube(), 8, 0.02, 2.0
    loads = np.linspace(0, 1, frames)[:, None, None] * pulled(tets, 3.0)
    clock = Clock(step_s=dt, mass_kg=0.2, damping=damping)
    u = march_in_time(tets, Tissue(2.0, 0.4, law), loads, np.linspace(0, 0.1, frames), clock).displacement
    mass = nodal_mass(tets, 0.2)[:, None]
    system = assemble(tets, law, 0.4)
    for t in range(2, frames):
        inertia = mass * ((u[t] - 2 * u[t - 1] + u[t - 2]) / dt**2 + damping * (u[t] - u[t - 1]) / dt)
        out = (2.0 * (loads[t] - system.state(u[t]).force) - inertia)[~tets.fixed]
        assert np.linalg.norm(out) <= 1e-2 * np.linalg.norm(inertia[~tets.fixed])
        assert np.linalg.norm(inertia) > 1e-2 * np.linalg.norm(2.0 * loads[t])  # something to balance
