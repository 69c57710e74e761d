"""Newton's method with exact tangents: slow and sure, what the fast solver is measured against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from synth.fem.equilibrium import NoEquilibrium
from synth.fem.system import System

Floats = NDArray[np.float64]


def newton(system: System, load: Floats, start: Floats, tolerance: float = 1e-8, steps: int = 60) -> Floats:
    """Equilibrium (N, 3) mm under `load` (N, 3) mN for E = 1 kPa; what is fixed stays as in `start`.

    `tolerance`: largest force out of balance, as a part of the largest nodal force. Raises NoEquilibrium if
    it is not reached in `steps` factorisations.
    """
    u, free = start.copy(), system.free
    for _ in range(steps):
        state = system.state(u)
        out = (load - state.force).ravel()[free]
        scale = max(np.abs(load).max(), np.abs(state.force).max())
        if np.abs(out).max() <= tolerance * scale:
            return u
        step = np.zeros(u.size)
        step[free] = splu(system.tangent(u)[free][:, free].tocsc()).solve(out)
        move, length = step.reshape(-1, 3), 1.0
        level, fall = state.energy - float(np.vdot(load, u)), float(out @ step[free])
        for _ in range(30):
            value = system.state(u + length * move).energy - float(np.vdot(load, u + length * move))
            if np.isfinite(value) and value <= level - 1e-4 * length * fall + 1e-12 * abs(level):
                break
            length *= 0.5
        u = u + length * move
    raise NoEquilibrium(f"Newton's method has not reached {tolerance:g} in {steps} steps")
