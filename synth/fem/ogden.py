"""Ogden's law of one term, compressible: tissue that stiffens as it strains.

With the stretches l of F, J = det F, and the stretches at equal volume m = l J^(-1/3),

    W = 2 mu / alpha^2 (m1^alpha + m2^alpha + m3^alpha - 3) + (lambda/2 + mu/3) (log J)^2.

At rest it is Hooke's law of mu and lambda, for every alpha. A negative alpha stiffens more in compression
than in tension, as brain does:

- alpha -4.7, mu 0.84 kPa: swine, tension and compression (Miller & Chinzei, J. Biomech. 35, 2002);
- alpha -19, mu 0.67 kPa: human, in vivo, sinking under gravity (Bennion et al., J. R. Soc. Interface, 2022);
- alpha about -20 and beyond: human, ex vivo, in shear, compression and tension together (Budday et al., Acta
  Biomater. 48, 2017, whose energy this is, at equal volume).

Its tangent is diagonal but for three rows in the frame of the singular vectors (Smith, de Goes & Kim, ACM
Trans. Graph. 38, 2019); negative eigenvalues can be cut there, which makes it a preconditioner.
"""

from __future__ import annotations

import numpy as np

from synth.arrays import Floats
from synth.system.jit import compiled

ALPHA = -4.7
"""Exponent where none is drawn: Miller and Chinzei's."""

_SWEEPS = 12  # of Jacobi's rotations; four or five bring a 3 x 3 matrix to rounding
_PAIRS = ((0, 1), (0, 2), (1, 2))
_EQUAL = 1e-6  # relative difference of two stretches below which they count as one


@compiled
def stress(strain: Floats, mu: float, lam: float, alpha: float, out: Floats, energy: Floats) -> None:
    """Writes the energy density (n,) kPa, infinite where J is not above 0, and P = dW/dF, `out` (n, 3, 3)
    kPa, at displacement gradients `strain` = F - I, (n, 3, 3)."""
    f, c, v = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    log, power, part = np.empty(3), np.empty(3), np.empty(3)
    bulk = lam + 2 * mu / 3
    for n in range(len(strain)):
        for i in range(3):
            for j in range(3):
                f[i, j] = strain[n, i, j]
            f[i, i] += 1
        det = f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1])
        det -= f[0, 1] * (f[1, 0] * f[2, 2] - f[1, 2] * f[2, 0])
        det += f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0])
        if not det > 0:
            energy[n] = np.inf
            for i in range(3):
                for j in range(3):
                    out[n, i, j] = 0.0
            continue
        for i in range(3):
            for j in range(3):
                c[i, j] = f[0, i] * f[0, j] + f[1, i] * f[1, j] + f[2, i] * f[2, j]
        _eigenvectors(c, v)
        swelling, total = np.log(det), 0.0
        for k in range(3):
            # A stretch that rounding has made negative is one of a J next to 0.
            log[k] = 0.5 * np.log(max(c[k, k], 1e-300))
            power[k] = np.exp(alpha * (log[k] - swelling / 3))
            total += power[k]
        energy[n] = 2 * mu / alpha**2 * (total - 3) + 0.5 * bulk * swelling * swelling
        for k in range(3):
            part[k] = 2 * mu / alpha * (power[k] - total / 3) + bulk * swelling
            part[k] *= np.exp(-2 * log[k])  # second Piola-Kirchhoff
        for i in range(3):
            for j in range(3):
                c[i, j] = (
                    part[0] * v[i, 0] * v[j, 0] + part[1] * v[i, 1] * v[j, 1] + part[2] * v[i, 2] * v[j, 2]
                )
        for i in range(3):
            for j in range(3):
                out[n, i, j] = f[i, 0] * c[0, j] + f[i, 1] * c[1, j] + f[i, 2] * c[2, j]


@compiled
def _eigenvectors(a: Floats, v: Floats) -> None:
    """Turns a symmetric (3, 3) `a` into its diagonal form and writes its eigenvectors into the columns of
    `v`, by Jacobi's rotations (Golub & Van Loan, Matrix Computations, 8.5)."""
    for i in range(3):
        for j in range(3):
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        off = a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2
        if off <= 1e-32 * (a[0, 0] ** 2 + a[1, 1] ** 2 + a[2, 2] ** 2):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2 * a[p, q])
                t = 1 / (abs(theta) + np.sqrt(theta * theta + 1))
                if theta < 0:
                    t = -t
                c = 1 / np.sqrt(t * t + 1)
                s = t * c
                for k in range(3):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * x - s * y, s * x + c * y


def tangent(
    strain: Floats,
    mu: float,
    lam: float,
    alpha: float,
    pressure: Floats | float = 0.0,
    *,
    positive: bool = False,
) -> Floats:
    """dP/dF at displacement gradients F - I, (n, 3, 3): (n, 3, 3, 3, 3) kPa; J must be above 0.

    `pressure`: (n,) kPa, p of an energy p log J that is added; `positive`: with negative eigenvalues cut off,
    so that a stiffness assembled of it is positive semi-definite.
    """
    u, stretch, w = np.linalg.svd(strain + np.eye(3))
    reflected = np.linalg.det(u) < 0  # det U = det V as J > 0
    u[reflected, :, 2] *= -1
    w[reflected, 2] *= -1
    log = np.log(stretch)
    swelling = log.sum(axis=1, keepdims=True)
    power, bulk = np.exp(alpha * (log - swelling / 3)), lam + 2 * mu / 3
    mean = power.mean(axis=1, keepdims=True)
    pressures = np.broadcast_to(np.asarray(pressure, np.float64), len(strain))[:, None]
    kirchhoff = 2 * mu / alpha * (power - mean) + bulk * swelling + pressures
    piola = kirchhoff / stretch
    eye = np.eye(3)
    hessian = (
        2 * mu * (eye * power[:, None] - (power[:, :, None] + power[:, None]) / 3 + mean[:, :, None] / 3)
    )
    hessian = (hessian + bulk - eye * kirchhoff[:, None]) / (stretch[:, :, None] * stretch[:, None])
    if positive:
        eigenvalues, eigenvectors = np.linalg.eigh(hessian)
        stretch_block = (eigenvectors * np.maximum(eigenvalues, 0)[:, None]) @ eigenvectors.swapaxes(1, 2)
    else:
        stretch_block = hessian
    local = np.zeros((len(strain), 3, 3, 3, 3))
    for i in range(3):
        for j in range(3):
            local[:, i, i, j, j] += stretch_block[:, i, j]
    for i, j in _PAIRS:
        gap, stretch_sum = stretch[:, i] - stretch[:, j], stretch[:, i] + stretch[:, j]
        same = np.abs(gap) < _EQUAL * stretch_sum
        flip = np.where(
            same, hessian[:, i, i] - hessian[:, i, j], (piola[:, i] - piola[:, j]) / np.where(same, 1.0, gap)
        )
        twist = (piola[:, i] + piola[:, j]) / stretch_sum
        if positive:
            flip, twist = np.maximum(flip, 0), np.maximum(twist, 0)
        diagonal, off_diagonal = 0.5 * (flip + twist), 0.5 * (flip - twist)
        local[:, i, j, i, j] += diagonal
        local[:, j, i, j, i] += diagonal
        local[:, i, j, j, i] += off_diagonal
        local[:, j, i, i, j] += off_diagonal
    half = np.einsum("nia,nabcd,nbj->nijcd", u, local, w, optimize=True)
    return np.asarray(np.einsum("nijcd,nkc,ndm->nijkm", half, u, w, optimize=True))
