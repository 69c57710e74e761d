"""Newton's method with tangents by differences: slow and sure, what the fast solver is measured against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, gmres

from synth.fem.equilibrium import NoEquilibrium, on_free
from synth.fem.system import System

Floats = NDArray[np.float64]

_STEP_MM = 1e-5


def newton(system: System, load: Floats, start: Floats, tolerance: float = 1e-8, steps: int = 60) -> Floats:
    """Equilibrium (N, 3) mm under `load` (N, 3) mN for E = 1 kPa; what is fixed stays as in `start`.

    `tolerance`: largest force out of balance, as a part of the largest nodal force. Raises NoEquilibrium if
    it is not reached in `steps` linear systems.
    """
    u, square = start.copy(), (start.size, start.size)

    def tangent(way: Floats) -> Floats:
        move = way.reshape(-1, 3) * (_STEP_MM / (np.abs(way).max() or 1.0))
        ahead, behind = (system.state(u + sign * move).force for sign in (1, -1))
        return on_free(system, ahead - behind).ravel() * (np.abs(way).max() or 1.0) / (2 * _STEP_MM)

    matrix = LinearOperator(square, tangent, dtype=np.float64)
    rest = LinearOperator(square, lambda force: system.solve(force.reshape(-1, 3)).ravel(), dtype=np.float64)
    for _ in range(steps):
        state = system.state(u)
        out = on_free(system, load - state.force).ravel()
        if np.abs(out).max() <= tolerance * max(np.abs(load).max(), np.abs(state.force).max()):
            return u
        step, _ = gmres(matrix, out, rtol=1e-6, M=rest, maxiter=5, restart=40)
        move, length = step.reshape(-1, 3), 1.0
        level, fall = state.energy - float(np.vdot(load, u)), float(out @ step)
        for _ in range(30):
            value = system.state(u + length * move).energy - float(np.vdot(load, u + length * move))
            if np.isfinite(value) and value <= level - 1e-4 * length * fall + 1e-12 * abs(level):
                break
            length *= 0.5
        u = u + length * move
    raise NoEquilibrium(f"Newton's method has not reached {tolerance:g} in {steps} steps")
