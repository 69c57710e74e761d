"""Time: inertia with damping, and tissue that relaxes, step by step.

Both turn a step into equilibrium with other springs under another load, so that the quasi-static solver and
one factorisation serve here too. Inertia: backward Euler, M a + d M v + f(u) = load, as in Heraoui et al.
Relaxation: quasi-linear viscoelasticity (Fung), its stress a Prony series over the elastic one, stepped by
the recurrence of Taylor, Pister & Goudreau (Int. J. Numer. Meth. Eng. 2, 1970), exact for stress that changes
evenly in a step. Since nodal forces are linear in stress, the history is kept as nodal forces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from synth.fem.equilibrium import TOLERANCE, NoEquilibrium, Path, check_state, minimise_energy
from synth.fem.membrane import Sheet
from synth.fem.mesh.element import quadrature
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.system import State, assemble

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Clock:
    """What time does to the tissue."""

    step_s: float
    """Between two loads."""
    substeps: int = 1
    """Steps of the solver between two loads."""
    mass_kg: float = 0.0
    """Of the whole brain; 0 leaves inertia out."""
    damping: float = 0.0
    """1/s, by mass."""
    relaxation: tuple[tuple[float, float], ...] = ()
    """Prony terms: the part of the stiffness that is lost, and its time [s]."""

    @property
    def dt(self) -> float:
        """Step of the solver [s]."""
        return self.step_s / self.substeps

    @property
    def fade(self) -> list[tuple[float, float, float]]:
        """Of each Prony term, its part, what is left of it after a step, and the same in the mean of it."""
        return [
            (part, float(np.exp(-self.dt / tau)), float(tau / self.dt * -np.expm1(-self.dt / tau)))
            for part, tau in self.relaxation
        ]

    @property
    def firmness(self) -> float:
        """How stiff the tissue is to a change within a step, as a part of that to a sudden load."""
        return 1 - sum(part for part, _, _ in self.fade) + sum(part * even for part, _, even in self.fade)

    @property
    def pull(self) -> float:
        """Backward Euler's mass and damping as a spring, 1/s^2; 0 without inertia."""
        return (1 / self.dt**2 + self.damping / self.dt) if self.mass_kg else 0.0

    def ahead(self, u: Floats, before: Floats) -> Floats:
        """Where that spring has no force (N, 3) mm, after two states of a step's distance."""
        kept = (2 * u - before) / self.dt**2 + self.damping / self.dt * u
        return np.asarray(kept / self.pull)


class _Memory:
    """What relaxing tissue keeps of its past, as nodal forces."""

    def __init__(self, clock: Clock) -> None:
        self._fade = clock.fade
        self._elastic: Floats | None = None
        self._history: list[Floats] = []

    def add(self, load: Floats) -> Floats:
        """A step's load (N, 3) mN with the past in it."""
        if self._elastic is not None:
            for (part, decay, even), past in zip(self._fade, self._history, strict=True):
                load = load - decay * past + part * even * self._elastic
        return load

    def keep(self, now: Floats) -> None:
        """Takes up the elastic forces (N, 3) mN at a step's end."""
        if self._elastic is None:
            self._elastic, self._history = np.zeros_like(now), [np.zeros_like(now) for _ in self._fade]
        for k, (part, decay, even) in enumerate(self._fade):
            self._history[k] = decay * self._history[k] + part * even * (now - self._elastic)
        self._elastic = now


def march_in_time(
    tets: Tets,
    law: str,
    poisson: float,
    young_kpa: float,
    loads: Floats,
    named: Floats,
    clock: Clock,
    sheet: Sheet | None = None,
) -> Path:
    """Motion from rest under loads at even times; between them they change evenly.

    Args:
        tets: the mesh.
        law: a key of `laws.NUMBER`; its stiffness is that of a sudden load.
        poisson: below 0.5.
        young_kpa: E, which sets how much inertia counts.
        loads: (T, N, 3) mN for E = 1 kPa.
        named: (T,) P = F/(E a^2) of each, for messages.
        clock: time.
        sheet: a membrane on the surface; it relaxes as the tissue does.

    Raises:
        As `equilibrium.solve_path`.
    """
    memory, firm, pull = _Memory(clock), clock.firmness, clock.pull
    mass = nodal_mass(tets, clock.mass_kg) / young_kpa
    springs = (tets.hold + sp.diags_array(pull * mass)) / firm
    slip = None if tets.slip is None else sp.csr_array(tets.slip / firm)
    held = replace(tets, hold=sp.csr_array(springs), slip=slip)
    system = assemble(held, law, poisson, sheet)
    tissue = replace(system, hold=sp.csr_array(tets.hold.shape), slip=None)
    skull = replace(system, hold=tets.hold, slip=tets.slip)

    peak = loads[np.abs(loads).max(axis=(1, 2)).argmax()]
    size = float(np.sqrt(np.vdot(peak, system.solve(peak)))) / firm
    u = before = np.zeros_like(loads[0])
    states: list[tuple[Floats, State, float, float]] = []
    for t in range(len(loads)):
        for sub in range(1, clock.substeps + 1 if t else 2):
            share = sub / clock.substeps
            load = loads[t] if t == 0 else (1 - share) * loads[t - 1] + share * loads[t]
            load = memory.add(load)
            if pull:
                load = load + pull * mass[:, None] * clock.ahead(u, before)
            new, state, norm = minimise_energy(system, load / firm, u + (u - before), TOLERANCE * size, u)
            least = check_state(system, new, state, t, float(named[t]))
            memory.keep(tissue.state(new).force)
            before, u = u, new
            if norm > 2 * TOLERANCE * size:
                raise NoEquilibrium(f"frame {t}: no equilibrium at load {named[t]:.3g}; lower the load")
        states.append((u, tissue.state(u), norm / size, least))
    return Path(
        np.stack([u for u, _, _, _ in states]),
        np.array([least for _, _, _, least in states]),
        np.array([s.energy + 0.5 * float(np.vdot(u, skull.springs(u))) for u, s, _, _ in states]),
        np.array([r for _, _, r, _ in states]),
    )


def nodal_mass(tets: Tets, mass_kg: float) -> Floats:
    """(N,) kg, spread evenly over the volume; within an element as the diagonal of its consistent mass.

    Hinton, Rock & Zienkiewicz, Earthq. Eng. Struct. Dyn. 4, 1976.
    """
    shares = np.full(4, 0.25) if tets.order == 1 else np.repeat([1 / 36, 4 / 27], [4, 6])
    spread = np.bincount(tets.cells.ravel(), np.outer(volume(tets), shares).ravel(), len(tets.points))
    return np.asarray(mass_kg * spread / spread.sum())


def volume(tets: Tets) -> Floats:
    """(M,) mm^3 of the elements."""
    return np.asarray(quadrature(tets.points, tets.cells, tets.order).weight.sum(axis=1))
