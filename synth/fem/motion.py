"""Dynamics: inertia with damping, and relaxation of the tissue, step by step.

Both turn a step into an equilibrium with other springs under another load, so that the quasi-static solver
and one factorisation serve here too. Inertia: backward Euler, M a + d M v + f(u) = load, as in Heraoui et al.
Relaxation: quasi-linear viscoelasticity (Fung), its stress a Prony series over the elastic one, stepped by
the recurrence of Taylor, Pister & Goudreau (Int. J. Numer. Meth. Eng. 2, 1970), exact for stress that changes
linearly in a step. Since nodal forces are linear in stress, the history is stored as nodal forces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import scipy.sparse as sp

from synth.arrays import Floats
from synth.fem.equilibrium import TOLERANCE, LoadPath, follow_loads, minimise_energy
from synth.fem.material import Tissue
from synth.fem.mesh.element import quadrature
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.system import State


@dataclass(frozen=True)
class TimeScheme:
    """How tissue follows its load in time."""

    time: Literal["quasi-static", "dynamic"] = "quasi-static"  # equilibrium in every frame, or inertia
    mass_kg: float | None = None  # of the whole volume; None: that of grey and white matter
    relaxation: tuple[tuple[float, float], ...] = ()  # Prony terms, as of `Clock`


@dataclass(frozen=True)
class Clock:
    """Time steps, inertia and relaxation."""

    step_s: float  # s, between two loads
    substeps: int = 1  # solver steps between two loads
    mass_kg: float = 0.0  # of the whole brain; 0: no inertia
    damping: float = 0.0  # 1/s, mass-proportional
    relaxation: tuple[tuple[float, float], ...] = ()  # Prony terms: lost part of the stiffness, time [s]

    @property
    def dt(self) -> float:
        """Step of the solver [s]."""
        return self.step_s / self.substeps

    @property
    def prony_terms(self) -> list[tuple[float, float, float]]:
        """For each Prony term its part of the stiffness, its decay over a step, and that decay's mean."""
        return [
            (part, float(np.exp(-self.dt / tau)), float(tau / self.dt * -np.expm1(-self.dt / tau)))
            for part, tau in self.relaxation
        ]

    @property
    def relative_stiffness(self) -> float:
        """Stiffness to a change within a step, relative to that to a sudden load."""
        terms = self.prony_terms
        return 1 - sum(part for part, _, _ in terms) + sum(part * mean for part, _, mean in terms)

    @property
    def inertia_spring(self) -> float:
        """Mass and damping of backward Euler as a spring, 1/s^2; 0 without inertia."""
        return (1 / self.dt**2 + self.damping / self.dt) if self.mass_kg else 0.0

    def inertia_target(self, u: Floats, before: Floats) -> Floats:
        """Displacement (N, 3) mm at which that spring is free of force, from the last two states."""
        momentum = (2 * u - before) / self.dt**2 + self.damping / self.dt * u
        return np.asarray(momentum / self.inertia_spring)


class PronyHistory:
    """History of relaxing tissue, as nodal forces."""

    def __init__(self, clock: Clock) -> None:
        self._terms = clock.prony_terms
        self._elastic: Floats | None = None
        self._history: list[Floats] = []

    def add_to(self, load: Floats) -> Floats:
        """A step's load (N, 3) mN plus the forces of the history."""
        if self._elastic is not None:
            for (part, decay, mean), force in zip(self._terms, self._history, strict=True):
                load = load - decay * force + part * mean * self._elastic
        return load

    def update(self, force: Floats) -> None:
        """Advances the history by the elastic forces (N, 3) mN at a step's end."""
        if self._elastic is None:
            self._elastic, self._history = np.zeros_like(force), [np.zeros_like(force) for _ in self._terms]
        for k, (part, decay, mean) in enumerate(self._terms):
            self._history[k] = decay * self._history[k] + part * mean * (force - self._elastic)
        self._elastic = force


def march_in_time(
    tets: Tets, tissue: Tissue, loads: Floats, load_parameter: Floats, clock: Clock
) -> LoadPath:
    """Motion from rest under loads at equal time steps, interpolated linearly between them; otherwise as
    `equilibrium.solve_path`. `tissue`: its stiffness to a sudden load; a membrane relaxes as it does."""
    stiffness, spring, substeps = clock.relative_stiffness, clock.inertia_spring, clock.substeps
    mass = nodal_mass(tets, clock.mass_kg) / tissue.young_kpa
    springs = (tets.hold + sp.diags_array(spring * mass)) / stiffness
    slip = None if tets.slip is None else sp.csr_array(tets.slip / stiffness)
    system = tissue.equations(replace(tets, hold=sp.csr_array(springs), slip=slip))
    elastic = replace(system, hold=sp.csr_array(tets.hold.shape), slip=None)
    skull = replace(system, hold=tets.hold, slip=tets.slip)

    peak = loads[np.abs(loads).max(axis=(1, 2)).argmax()]
    size = float(np.sqrt(np.vdot(peak, system.solve(peak)))) / stiffness or 1.0
    history, before = PronyHistory(clock), np.zeros_like(peak)

    def step(load: Floats, u: Floats) -> tuple[Floats, State, float]:
        nonlocal before
        load = history.add_to(load)
        if spring:
            load = load + spring * mass[:, None] * clock.inertia_target(u, before)
        next_u, state, norm = minimise_energy(system, load / stiffness, u + (u - before), TOLERANCE * size, u)
        history.update(elastic.state(next_u).force)
        before = u
        return next_u, state, norm / size

    steps = [loads[0]]
    for begin, end in pairwise(loads):
        steps += [(1 - s / substeps) * begin + s / substeps * end for s in range(1, substeps + 1)]
    path = follow_loads(system, np.array(steps), load_parameter, step, 2 * TOLERANCE, substeps)
    energy = [elastic.state(u).energy + 0.5 * float(np.vdot(u, skull.springs(u))) for u in path.displacement]
    return replace(path, energy=np.array(energy))


def nodal_mass(tets: Tets, mass_kg: float) -> Floats:
    """Mass (N,) kg of the nodes, even over the volume; in an element by its consistent mass's diagonal.

    Hinton, Rock & Zienkiewicz, Earthq. Eng. Struct. Dyn. 4, 1976.
    """
    shares = np.repeat([1 / 36, 4 / 27], [4, 6])
    spread = np.bincount(tets.cells.ravel(), np.outer(volume(tets), shares).ravel(), len(tets.points))
    return np.asarray(mass_kg * spread / spread.sum())


def volume(tets: Tets) -> Floats:
    """(M,) mm^3 of the elements."""
    return np.asarray(quadrature(tets.points, tets.cells).weight.sum(axis=1))
