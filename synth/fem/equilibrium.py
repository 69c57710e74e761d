"""Equilibrium along a path of loads: one solve, or L-BFGS on the stiffness at rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from synth.arrays import Floats
from synth.errors import NotFinite, UserError
from synth.fem.law_choice import LEAST_JACOBIAN
from synth.fem.system import State, System

TOLERANCE = 2e-4
"""Force out of balance, as a part of the load, at which a step ends."""
_HISTORY, _ITERATIONS, _ARMIJO = 8, 200, 1e-4
_DIRECTIONS = 3  # of loads, up to which a state is extrapolated from all earlier ones


_Step = tuple[Floats, Floats, float, Floats]
"""Step s (N, 3) mm, the gradient's change y (N, 3) mN over it, s'y, and the inverse rest stiffness on y."""


class ExcessiveLoad(UserError):
    """A load that the mesh does not bear."""


class NoEquilibrium(ExcessiveLoad):
    """The iteration found no balance of forces."""


class InvertedElement(ExcessiveLoad):
    """The load is too large for the mesh: an element is flat or inside out."""


@dataclass(frozen=True)
class LoadPath:
    """States of the volume over T loads, for E = 1 kPa."""

    displacement: Floats  # (T, N, 3) mm
    jacobian: Floats  # (T,) smallest det F, at quadrature points and the elements' corners
    energy: Floats  # (T,) mN mm
    residual: Floats  # (T,) out-of-balance force over the load, in the inverse stiffness's norm; 0 unloaded


Step = Callable[[Floats, Floats], tuple[Floats, State, float]]
"""From a load (N, 3) mN and the displacement (N, 3) mm before it: the displacement under it, its state, and
the force out of balance as a part of the largest load."""


def solve_path(system: System, loads: Floats, load_parameter: Floats) -> LoadPath:
    """Equilibrium under each of the loads (T, N, 3) mN for E = 1 kPa in turn.

    `load_parameter`: (T,) P = F/(E a^2) of each, for messages. Raises, with frame and load: InvertedElement;
    NoEquilibrium, where the iteration stalls; NotFinite.
    """
    linear = _LinearResponse(system)
    peak = loads[np.abs(loads).max(axis=(1, 2)).argmax()]
    peak_norm = float(np.sqrt(np.vdot(peak, peak))) or 1.0
    scale = float(np.sqrt(np.vdot(peak, linear(peak)))) or 1.0
    extrapolation = _NonlinearExtrapolation(linear)

    def step(load: Floats, previous: Floats) -> tuple[Floats, State, float]:
        if system.law == "linear":
            u = linear(load)
            state = system.state(u)
            return u, state, float(np.linalg.norm(mask_fixed(system, load - state.force)) / peak_norm)
        start = extrapolation.predict(load)
        u, state, norm = minimise_energy(system, load, start, TOLERANCE * scale, previous)
        extrapolation.add(load, u)
        return u, state, norm / scale

    return follow_loads(system, loads, load_parameter, step, TOLERANCE, substeps=1)


def follow_loads(
    system: System, loads: Floats, load_parameter: Floats, step: Step, tolerance: float, substeps: int
) -> LoadPath:
    """States that `step` finds under each load in turn, from rest; arguments and errors as of `solve_path`.

    `tolerance`: accepted force out of balance, as a part of the largest load; `substeps`: loads per frame;
    the first frame has one.
    """
    u = np.zeros_like(loads[0])
    path = []
    for number, load in enumerate(loads):
        frame = -(-number // substeps)
        parameter = float(load_parameter[frame])
        u, state, residual = step(load, u)
        min_jacobian = check_state(system, u, state, frame, parameter)
        if residual > tolerance:
            fault = f"no equilibrium at load {parameter:.3g} (out of balance by {residual:.1e})"
            raise NoEquilibrium(f"frame {frame}: {fault}; lower the load")
        path.append((u, min_jacobian, state.energy, residual))
    displacement, jacobians, energy, residuals = zip(*path[::substeps], strict=True)
    return LoadPath(np.stack(displacement), np.array(jacobians), np.array(energy), np.array(residuals))


class _LinearResponse:
    """Linear displacement under loads that span few directions: one solve for each new direction."""

    def __init__(self, system: System) -> None:
        self._system, self._directions, self._responses = system, list[Floats](), list[Floats]()

    def shares(self, load: Floats) -> Floats:
        """Components (K,) of a load along the directions so far."""
        return np.array([float(np.vdot(direction, load)) for direction in self._directions])

    def __call__(self, load: Floats) -> Floats:
        size = float(np.linalg.norm(load))
        u, remainder = np.zeros_like(load), load
        for direction, response in zip(self._directions, self._responses, strict=True):
            share = float(np.vdot(direction, remainder))
            u = u + share * response
            remainder = remainder - share * direction
        remainder_norm = float(np.linalg.norm(remainder))
        if remainder_norm <= 1e-10 * size:
            return u
        direction = remainder / remainder_norm
        response = self._system.solve(direction)
        self._directions.append(direction)
        self._responses.append(response)
        return u + remainder_norm * response


class _NonlinearExtrapolation:
    """Prediction of states under loads that span few directions: their deviation from the linear response as
    a polynomial of second and third degree in the loads' components, by least squares."""

    def __init__(self, linear: _LinearResponse) -> None:
        self._linear, self._shares, self._deviations = linear, list[Floats](), list[Floats]()

    def add(self, load: Floats, u: Floats) -> None:
        """Stores the state u (N, 3) mm under a load (N, 3) mN."""
        self._deviations.append(u - self._linear(load))
        self._shares.append(self._linear.shares(load))

    def predict(self, load: Floats) -> Floats:
        u = self._linear(load)
        shares = self._linear.shares(load)
        components = np.zeros((len(self._shares) + 1, len(shares)))
        for row, row_shares in zip(components, [*self._shares, shares], strict=True):
            row[: len(row_shares)] = row_shares
        components = components[:, np.abs(components[:-1]).max(axis=0, initial=0) > 0]
        if not 0 < components.shape[1] <= _DIRECTIONS:
            return u + (self._deviations[-1] if self._deviations else 0.0)
        components /= np.abs(components).max(axis=0)
        axes = range(components.shape[1])
        factor_sets = [*combinations_with_replacement(axes, 2), *combinations_with_replacement(axes, 3)]
        terms = np.stack([components[:, list(factors)].prod(axis=1) for factors in factor_sets], axis=1)
        for weight, deviation in zip(
            terms[-1] @ np.linalg.pinv(terms[:-1], 1e-6), self._deviations, strict=True
        ):
            u = u + weight * deviation
        return u


def check_state(system: System, u: Floats, state: State, frame: int, load: float) -> float:
    """Smallest det F of displacements u (N, 3) mm. Raises NotFinite or InvertedElement."""
    if not np.isfinite(u).all() or not np.isfinite(state.energy):
        raise NotFinite(f"frame {frame}: the deformation at load {load:.3g} is not finite")
    min_jacobian, element = system.least_jacobian(u)
    if min_jacobian <= LEAST_JACOBIAN:
        fault = f"load {load:.3g} turns element {element} inside out or nearly so"
        limit = f"(det F {min_jacobian:.2f}, more than {LEAST_JACOBIAN:g} is needed)"
        raise InvertedElement(f"frame {frame}: {fault} {limit}; lower the load")
    return min_jacobian


def minimise_energy(
    system: System,
    load: Floats,
    start: Floats,
    tolerance: float,
    fallback: Floats,
    iterations: int = _ITERATIONS,
) -> tuple[Floats, State, float]:
    """Minimises stored energy less the load's work by L-BFGS on the factored rest stiffness.

    Nocedal & Wright, Numerical Optimization, 7.4; Liu, Bouaziz & Kavan, "Quasi-Newton methods for real-time
    simulation of hyperelastic materials" (ACM Trans. Graph. 36, 2017).

    `load`: (N, 3) mN; `start`, `fallback`: (N, 3) mm, and one of finite energy, used where `start` has none;
    `tolerance`: on the residual's norm sqrt(r' K^-1 r), in sqrt(mN mm); `iterations`: at most. Returns
    displacement, its state and the residual's norm, which may exceed the tolerance.
    """
    u, state = start, system.state(start)
    if not np.isfinite(state.energy):
        u, state = fallback, system.state(fallback)
    gradient = mask_fixed(system, state.force - load)
    history: list[_Step] = []
    norm = np.inf
    preconditioned = system.solve(gradient)
    for _ in range(iterations):
        norm = max(float(np.vdot(gradient, preconditioned)), 0.0) ** 0.5
        if norm <= tolerance:
            break
        direction = -_two_loop_recursion(gradient, preconditioned, history)
        derivative = float(np.vdot(gradient, direction))
        if derivative >= 0:
            history.clear()
            direction, derivative = -preconditioned, -(norm**2)
        length, potential = 1.0, state.energy - float(np.vdot(load, u))
        for _ in range(30):
            trial = u + length * direction
            trial_state = system.state(trial)
            value = trial_state.energy - float(np.vdot(load, trial))
            rounding = 1e-14 * abs(potential)  # near the minimum
            if np.isfinite(value) and value <= potential + _ARMIJO * length * derivative + rounding:
                break
            length *= 0.5
        else:
            break
        trial_gradient = mask_fixed(system, trial_state.force - load)
        s, y = length * direction, trial_gradient - gradient
        curvature = float(np.vdot(s, y))
        previous, preconditioned = preconditioned, system.solve(trial_gradient)
        if curvature > 1e-12 * float(np.sqrt(np.vdot(s, s) * np.vdot(y, y))):
            history.append((s, y, curvature, preconditioned - previous))
            del history[:-_HISTORY]
        u, state, gradient = trial, trial_state, trial_gradient
    return u, state, norm


def _two_loop_recursion(gradient: Floats, preconditioned: Floats, history: list[_Step]) -> Floats:
    """The inverse Hessian times the gradient (Nocedal & Wright, algorithm 7.4), with the rest stiffness as
    its seed; `preconditioned` (N, 3) mm is the inverse rest stiffness times the gradient (N, 3) mN."""
    q, r, alphas = gradient.copy(), preconditioned.copy(), []
    for s, y, curvature, preconditioned_y in reversed(history):
        alpha = float(np.vdot(s, q)) / curvature
        q -= alpha * y
        r -= alpha * preconditioned_y
        alphas.append(alpha)
    for (s, y, curvature, _), alpha in zip(history, reversed(alphas), strict=True):
        r += s * (alpha - float(np.vdot(y, r)) / curvature)
    return r


def mask_fixed(system: System, force: Floats) -> Floats:
    """The force (N, 3) mN at free degrees of freedom, 0 at fixed ones."""
    out = np.zeros(force.size)
    out[system.free] = force.ravel()[system.free]
    return out.reshape(-1, 3)
