"""Newton's method by SciPy: slow and sure, what the fast solver is measured against."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import newton_krylov
from scipy.sparse.linalg import LinearOperator

from synth.fem.equilibrium import mask_fixed
from synth.fem.system import System

Floats = NDArray[np.float64]


def newton(system: System, load: Floats, start: Floats, tolerance: float = 1e-8) -> Floats:
    """Equilibrium (N, 3) mm under `load` (N, 3) mN for E = 1 kPa; what is fixed stays as in `start`.

    `tolerance`: largest force out of balance, as a part of the largest nodal force at the start. Raises
    NoConvergence if it is not reached.
    """
    size = max(np.abs(load).max(), np.abs(system.state(start).force).max())
    solution = newton_krylov(
        lambda u: mask_fixed(system, system.state(u).force - load),
        start,
        method="gmres",
        inner_M=LinearOperator((start.size,) * 2, lambda f: system.solve(f.reshape(-1, 3)).ravel()),
        f_tol=tolerance * size,
        maxiter=60,
    )
    return np.asarray(solution)
