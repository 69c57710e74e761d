"""Springs of attachments and of the skull; inertia and relaxation against the equations they step."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from dome import ANATOMY
from pydantic import ValidationError

from synth.errors import UserError
from synth.fem.material import Tissue
from synth.fem.mesh import attachments, tetrahedra
from synth.fem.mesh.tetrahedra import Tets, boundary
from synth.fem.motion import Clock, march_in_time, nodal_mass
from synth.fem.system import assemble
from synth.geometry.skull import Attachment
from synth.job import schema

FALX = Attachment(point=(14, 0, -20), normal=(1, 0, 0), radius_mm=18, thickness_mm=6)


def pull_opening(tets: Tets) -> np.ndarray:
    """Displacement (N, 3) mm under an even pull on the opening, upwards and aside."""
    close_nodes = np.linalg.norm(tets.points, axis=1) < 7
    outer_nodes = np.isin(np.arange(len(close_nodes)), tetrahedra.boundary(tets.cells[:, :4]))
    return assemble(tets, "linear", 0.4).solve(np.outer(close_nodes & outer_nodes, (0.5, 0.0, 1.0)))


@pytest.mark.slow
def test_an_attachment_holds_its_region_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attachments, "FIRM_PER_MM", 20.0)
    free_tets = tetrahedra.block(2500)
    held_tets = tetrahedra.block(2500, attachments=(FALX,))
    free_mm, held_mm = (np.linalg.norm(pull_opening(tets), axis=1) for tets in (free_tets, held_tets))
    wide_sizes = {"radius_mm": FALX.radius_mm + 8, "thickness_mm": FALX.thickness_mm + 16}
    inside = attachments.contains(FALX, free_tets.points)
    beyond = ~attachments.contains(replace(FALX, **wide_sizes), free_tets.points)
    assert inside.sum() >= 3
    assert held_mm[inside].sum() < 0.1 * free_mm[inside].sum()
    assert held_mm[beyond].sum() > 0.6 * free_mm[beyond].sum()


def test_springs_scale_with_the_attachments_volume() -> None:
    """A rigid shift by 1 mm costs firm/thickness times the volume of the sheet."""
    tets = tetrahedra.block(1500)
    disc = Attachment(point=(0, 0, -25), normal=(0, 0.6, 0.8), radius_mm=15, thickness_mm=4)
    ones = np.ones(len(tets.points))
    total = ones @ (attachments.springs(tets.points, tets.cells, (disc,)) @ ones)
    assert total == pytest.approx(2 * np.pi * 15**2, rel=0.05)


def test_an_attachment_without_tissue_or_direction_is_refused() -> None:
    nowhere = Attachment(point=(0, 0, 40), radius_mm=5)
    with pytest.raises(UserError, match="attachments"):
        tetrahedra.block(300, attachments=(nowhere,))
    for settings in ({"normal": (0, 0, 0)}, {"radius_mm": -1}):
        with pytest.raises(ValidationError):
            schema.AttachmentSection.model_validate({"point": (0, 0, -20), "radius_mm": 5} | settings)


def test_slip_is_as_firm_along_the_normal_and_free_along_the_surface() -> None:
    bonded_tets = tetrahedra.block(300)
    slipping_tets = tetrahedra.block(300, slips=True)
    assert bonded_tets.slip is None
    assert slipping_tets.slip is not None
    soft_system, firm_system = assemble(slipping_tets, "linear", 0.4), assemble(bonded_tets, "linear", 0.4)
    top = boundary(bonded_tets.cells)
    top = np.unique(top[~bonded_tets.fixed[top].all(axis=1)])
    normal = np.zeros_like(bonded_tets.points)
    normal[top] = bonded_tets.points[top] + [0, 0, ANATOMY.dome_mm]  # the dome's centre
    shallow = top[bonded_tets.points[top, 2] > -20]
    normal[np.setdiff1d(np.arange(len(normal)), shallow)] = 0
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    tangent = np.cross(normal, [1.0, 0.3, 0.0])

    def compute_energies(u: np.ndarray) -> tuple[float, float]:
        return float(np.vdot(u, soft_system.springs(u))), float(np.vdot(u, firm_system.springs(u)))

    slip, bond = compute_energies(normal)
    assert slip == pytest.approx(bond, rel=0.04)  # coarse faces on a round dome
    slip, bond = compute_energies(tangent)
    assert slip < 0.02 * bond


def test_damped_motion_comes_to_rest_in_equilibrium() -> None:
    tets = tetrahedra.block(300, slips=True)
    load = np.zeros_like(tets.points)
    load[np.hypot(*tets.points[:, :2].T) < 15] = [0.05, 0.0, -0.02]
    loads, tissue = np.stack([load] * 40), Tissue(1.0, 0.4, "linear")
    motion = march_in_time(tets, tissue, loads, np.full(40, 0.1), Clock(0.5, 1, 1.0, 20.0))
    equilibrium = assemble(tets, "linear", 0.4).solve(load)
    assert np.abs(motion.displacement[-1] - equilibrium).max() <= 2e-3 * np.abs(equilibrium).max()
    assert motion.energy[-1] == pytest.approx(0.5 * float(np.vdot(load, equilibrium)), rel=5e-3)


def cube() -> Tets:
    """A cube of 10 mm on a fixed floor."""
    points, cells = tetrahedra.with_midsides(*tetrahedra.bricks(np.array([10.0, 10.0, 10.0]), 8))
    return Tets(points, cells, points[:, 2] < -10 + 1e-9, sp.csr_array((len(points),) * 2))


def pull_top(tets: Tets, load: float) -> np.ndarray:
    """An even pull on the top, (N, 3) mN."""
    top = tets.points[:, 2] > -1e-9
    return np.outer(top / top.sum(), [0.3, 0.0, load])


def test_creep_under_a_held_load_is_the_closed_form() -> None:
    """J(t) = 1/g - (1/g - 1) exp(-g t / tau), g the part of the stiffness that stays."""
    tets, lost_share, tau = cube(), 0.4, 0.5
    remainder, load, frames = 1 - lost_share, pull_top(tets, 1.0), 41
    loads = np.repeat(load[None], frames, axis=0)
    loads[0] = 0
    clock = Clock(step_s=0.02, relaxation=((lost_share, tau),))
    path = march_in_time(tets, Tissue(1.0, 0.4, "linear"), loads, np.full(frames, 0.1), clock)
    elastic = assemble(tets, "linear", 0.4).solve(load)
    creep = np.einsum("tnd,nd->t", path.displacement, elastic) / np.vdot(elastic, elastic)
    time_s = 0.02 * np.arange(frames) - 0.01  # the load comes on evenly within the first step
    exact = 1 / remainder - (1 / remainder - 1) * np.exp(-remainder * time_s / tau)
    np.testing.assert_allclose(creep[2:], exact[2:], rtol=1e-3)


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_a_step_keeps_the_balance_of_momentum(law: str) -> None:
    tets, frames, dt, damping = cube(), 8, 0.02, 2.0
    loads = np.linspace(0, 1, frames)[:, None, None] * pull_top(tets, 3.0)
    clock = Clock(step_s=dt, mass_kg=0.2, damping=damping)
    u = march_in_time(tets, Tissue(2.0, 0.4, law), loads, np.linspace(0, 0.1, frames), clock).displacement
    mass = nodal_mass(tets, 0.2)[:, None]
    system = assemble(tets, law, 0.4)
    for t in range(2, frames):
        inertia = mass * ((u[t] - 2 * u[t - 1] + u[t - 2]) / dt**2 + damping * (u[t] - u[t - 1]) / dt)
        residual = (2.0 * (loads[t] - system.state(u[t]).force) - inertia)[~tets.fixed]
        assert np.linalg.norm(residual) <= 1e-2 * np.linalg.norm(inertia[~tets.fixed])
        assert np.linalg.norm(inertia) > 1e-2 * np.linalg.norm(2.0 * loads[t])  # something to balance
