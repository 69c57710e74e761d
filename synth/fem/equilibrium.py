"""Quasi-static equilibrium along a load's course: one solve, or L-BFGS on the stiffness at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.errors import NotFinite, UserError
from synth.fem.system import State, System
from synth.job.law_limits import LEAST_JACOBIAN

Floats = NDArray[np.float64]

TOLERANCE = 2e-4
"""Force out of balance, as a part of the load, at which a step ends."""
_MEMORY, _STEPS = 8, 200


class NoEquilibrium(UserError):
    """The iteration found no balance of forces."""


class InvertedElement(UserError):
    """The load is past what the mesh can follow: an element is flat or inside out."""


@dataclass(frozen=True)
class Path:
    """States of the volume over T steps, for E = 1 kPa."""

    displacement: Floats
    """(T, N, 3) mm."""
    jacobian: Floats
    """(T,) smallest det F."""
    energy: Floats
    """(T,) mN mm."""
    residual: Floats
    """(T,) force out of balance over the load, in the norm of the inverse stiffness; 0 without load."""


def follow(system: System, loads: Floats, named: Floats) -> Path:
    """Equilibrium under each load in turn.

    Args:
        system: the equations.
        loads: (T, N, 3) mN for E = 1 kPa.
        named: (T,) P = F/(E a^2) of each, for messages.

    Raises:
        InvertedElement: names frame, load and element.
        NoEquilibrium: the iteration stalled; names frame and load.
        NotFinite: a number is none.
    """
    path: list[tuple[Floats, State]] = []
    residual = np.zeros(len(loads))
    peak = loads[np.abs(loads).max(axis=(1, 2)).argmax()]
    answers = _Answers(system)
    first = answers(peak)
    square = float(np.vdot(peak, peak)) or 1.0
    size = float(np.sqrt(np.vdot(peak, first))) or 1.0
    known: list[tuple[float, Floats]] = [(0.0, np.zeros_like(peak))]
    for step, load in enumerate(loads):
        if system.law == "linear":
            u = answers(load)
            state = system.state(u)
            residual[step] = np.linalg.norm(_free(system, load - state.force)) / np.sqrt(square)
        else:
            part = float(np.vdot(load, peak)) / square
            alike = float(np.abs(load - part * peak).max()) <= 1e-9 * float(np.abs(peak).max())
            last = path[-1][0] if path else np.zeros_like(load)
            start = _guess(known, part, first) if alike else last + answers(load - loads[step - 1])
            u, state, rest = balance(system, load, start, TOLERANCE * size, last)
            residual[step] = rest / size
            if alike and all(abs(part - k) > 1e-3 for k, _ in known):
                known.append((part, u))
        check(system, u, state, step, float(named[step]))
        if residual[step] > TOLERANCE:
            raise NoEquilibrium(
                f"frame {step}: no equilibrium at load {named[step]:.3g} "
                f"(out of balance by {residual[step]:.1e}); lower the load"
            )
        path.append((u, state))
    return Path(
        np.stack([u for u, _ in path]),
        np.array([s.jacobian for _, s in path]),
        np.array([s.energy for _, s in path]),
        residual,
    )


class _Answers:
    """Linear displacement under loads that are mostly mixtures of few: one solve for each new direction."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._loads: list[Floats] = []
        self._moved: list[Floats] = []

    def __call__(self, load: Floats) -> Floats:
        size = float(np.linalg.norm(load))
        u, rest = np.zeros_like(load), load
        for direction, moved in zip(self._loads, self._moved, strict=True):
            share = float(np.vdot(direction, rest))
            u = u + share * moved
            rest = rest - share * direction
        left = float(np.linalg.norm(rest))
        if left <= 1e-10 * size:
            return u
        direction = rest / left
        moved = self._system.solve(direction)
        self._loads.append(direction)
        self._moved.append(moved)
        return u + left * moved


def check(system: System, u: Floats, state: State, frame: int, load: float) -> None:
    """Refuses displacements u (N, 3) mm that are no deformation: `NotFinite` or `InvertedElement`."""
    if not np.isfinite(u).all() or not np.isfinite(state.energy):
        raise NotFinite(f"frame {frame}: the deformation at load {load:.3g} is not finite")
    if state.jacobian <= LEAST_JACOBIAN:
        raise InvertedElement(
            f"frame {frame}: load {load:.3g} turns element {system.worst(u)} inside out or nearly so "
            f"(det F {state.jacobian:.2f}, more than {LEAST_JACOBIAN:g} is needed); lower the load"
        )


def balance(
    system: System, load: Floats, start: Floats, tolerance: float, safe: Floats
) -> tuple[Floats, State, float]:
    """Minimises stored energy less the load's work by L-BFGS on the factored rest stiffness.

    Nocedal & Wright, Numerical Optimization, 7.4; Liu, Bouaziz & Kavan, "Quasi-Newton methods for real-time
    simulation of hyperelastic materials" (ACM Trans. Graph. 36, 2017).

    Args:
        system: the equations.
        load: (N, 3) mN.
        start: (N, 3) mm.
        safe: (N, 3) mm, a state of finite energy, for when the guess `start` has none.
        tolerance: on the norm sqrt(r' K^-1 r) of what is out of balance, in sqrt(mN mm).

    Returns:
        Displacement, its state and the norm reached; the caller judges it.
    """
    u, state = start, system.state(start)
    if not np.isfinite(state.energy):
        u, state = safe, system.state(safe)
    slope = _free(system, state.force - load)
    memory: list[tuple[Floats, Floats, float]] = []
    rest = np.inf
    for _ in range(_STEPS):
        direct = system.solve(slope)
        rest = max(float(np.vdot(slope, direct)), 0.0) ** 0.5
        if rest <= tolerance:
            break
        step = -_descent(slope, direct, memory, system)
        fall = float(np.vdot(slope, step))
        if fall >= 0:
            memory.clear()
            step, fall = -direct, -(rest**2)
        length, level = 1.0, state.energy - float(np.vdot(load, u))
        for _ in range(30):
            trial = u + length * step
            new = system.state(trial)
            value = new.energy - float(np.vdot(load, trial))
            if np.isfinite(value) and value <= level + 1e-4 * length * fall + 1e-14 * abs(level):
                break
            length *= 0.5
        else:
            break
        after = _free(system, new.force - load)
        s, y = length * step, after - slope
        bend = float(np.vdot(s, y))
        if bend > 1e-12 * float(np.sqrt(np.vdot(s, s) * np.vdot(y, y))):
            memory.append((s, y, bend))
            del memory[:-_MEMORY]
        u, state, slope = trial, new, after
    return u, state, rest


def _descent(
    slope: Floats, direct: Floats, memory: list[tuple[Floats, Floats, float]], system: System
) -> Floats:
    """The inverse Hessian on the slope, by two loops round the rest stiffness."""
    if not memory:
        return direct
    q, rates = slope.copy(), []
    for s, y, bend in reversed(memory):
        rate = float(np.vdot(s, q)) / bend
        q -= rate * y
        rates.append(rate)
    r = system.solve(q)
    for (s, y, bend), rate in zip(memory, reversed(rates), strict=True):
        r += s * (rate - float(np.vdot(y, r)) / bend)
    return r


def _guess(known: list[tuple[float, Floats]], part: float, first: Floats) -> Floats:
    """The next state, through the known ones nearest in load: elastic states depend on nothing else."""
    nearest = sorted(known, key=lambda k: abs(k[0] - part))[:3]
    if len(nearest) == 1:
        return part * first
    value = np.zeros_like(first)
    for i, (at, u) in enumerate(nearest):
        share = 1.0
        for j, (other, _) in enumerate(nearest):
            if j != i:
                share *= (part - other) / (at - other)
        value += share * u
    return value


def _free(system: System, force: Floats) -> Floats:
    """The force without what the walls take."""
    out = np.zeros(force.size)
    out[system.free] = force.ravel()[system.free]
    return out.reshape(-1, 3)
