"""Material laws: energy and first Piola-Kirchhoff stress at every quadrature point.

All agree with Hooke's law of mu and lambda at rest. Sources, by name:
linear: Hooke, small strain. corotational: Muller & Gross, "Interactive virtual materials" (GI 2004), with the
energy mu |F - R|^2 + lambda/2 tr(R'F - I)^2, the law of Heraoui et al.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synth.fem.jit import compiled

Floats = NDArray[np.float64]

LINEAR, COROTATIONAL = 0, 1
NUMBER = {"linear": LINEAR, "corotational": COROTATIONAL}


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Lame's mu and lambda, in the unit of `young`."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


@compiled
def stress(law: int, strain: Floats, mu: float, lam: float, out: Floats, energy: Floats) -> float:
    """Energy density and stress, in place.

    Args:
        law: one of `NUMBER`.
        strain: (n, 3, 3) displacement gradient F - I.
        mu, lam: kPa.
        out: (n, 3, 3) kPa, overwritten by P = d(energy)/dF.
        energy: (n,) kPa, overwritten.

    Returns:
        The smallest det F.
    """
    least = np.inf
    f, r = np.empty((3, 3)), np.empty((3, 3))
    for p in range(len(strain)):
        for i in range(3):
            for j in range(3):
                f[i, j] = strain[p, i, j]
            f[i, i] += 1
        det = _det(f)
        least = min(least, det)
        if law == 0:
            for i in range(3):
                for j in range(3):
                    r[i, j] = 0.5 * (strain[p, i, j] + strain[p, j, i])
            trace = r[0, 0] + r[1, 1] + r[2, 2]
            squares = 0.0
            for i in range(3):
                for j in range(3):
                    squares += r[i, j] * r[i, j]
                    out[p, i, j] = 2 * mu * r[i, j]
                out[p, i, i] += lam * trace
            energy[p] = mu * squares + 0.5 * lam * trace * trace
        else:
            _rotation(f, r)
            trace, squares = -3.0, 0.0
            for i in range(3):
                for j in range(3):
                    trace += r[i, j] * f[i, j]
                    squares += (f[i, j] - r[i, j]) ** 2
            for i in range(3):
                for j in range(3):
                    out[p, i, j] = 2 * mu * (f[i, j] - r[i, j]) + lam * trace * r[i, j]
            energy[p] = mu * squares + 0.5 * lam * trace * trace
    return least


@compiled
def _det(f: Floats) -> float:
    return (  # type: ignore[no-any-return]
        f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1])
        - f[0, 1] * (f[1, 0] * f[2, 2] - f[1, 2] * f[2, 0])
        + f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0])
    )


@compiled
def _cofactor(f: Floats, c: Floats) -> None:
    for i in range(3):
        for j in range(3):
            a, b, k, m = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            c[i, j] = f[a, k] * f[b, m] - f[a, m] * f[b, k]


@compiled
def _rotation(f: Floats, r: Floats) -> None:
    """Rotation of the polar decomposition, by Newton's iteration (Higham, SIAM J. Sci. Stat. Comp. 7, 1986).

    An inside-out F has no nearest rotation that way: there the iteration ends at a reflection, which is as
    good as any, since the frame is refused for its determinant.
    """
    c = np.empty((3, 3))
    r[:] = f
    for _ in range(40):
        det = _det(r)
        if abs(det) < 1e-300:
            break
        _cofactor(r, c)
        change = 0.0
        for i in range(3):
            for j in range(3):
                new = 0.5 * (r[i, j] + c[i, j] / det)
                change = max(change, abs(new - r[i, j]))
                r[i, j] = new
        if change < 1e-15:
            break
