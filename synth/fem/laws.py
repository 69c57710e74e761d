"""Material laws: energy and first Piola-Kirchhoff stress at quadrature points.

All agree with Hooke's law of mu and lambda at rest. With F = I + grad u, J = det F, C = F'F:

linear          Hooke, small strain: mu e:e + lambda/2 (tr e)^2.
corotational    mu |F - R|^2 + lambda/2 tr(R'F - I)^2, R the rotation of F (Muller & Gross, GI 2004); the law
                of Heraoui et al.
neo-hookean     mu/2 (tr C - 3) - mu log J + lambda/2 (log J)^2 (Bonet & Wood, Nonlinear Continuum Mechanics,
                6.4.3): infinite energy at J = 0, so nothing turns inside out.
"""

from __future__ import annotations

import numpy as np

from synth.arrays import Floats
from synth.system.jit import argument_types, compiled, inlined

NUMBER = {"linear": 0, "corotational": 1, "neo-hookean": 2}
"""Number of each law in the compiled loops."""


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Lame's mu and lambda, in the unit of `young`."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


@argument_types("i8, f8[:,:,::1], f8, f8, f8[:,:,::1], f8[::1]")
@compiled
def stress(law: int, strain: Floats, mu: float, lam: float, out: Floats, energy: Floats) -> None:
    """Writes the energy density (n,) kPa, infinite where the law is undefined, and P = d(energy)/dF, `out`
    (n, 3, 3) kPa, of a `law` of `NUMBER` at displacement gradients `strain` = F - I, (n, 3, 3)."""
    f, r = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(strain)):
        _deformation(strain[n], f)
        if law == 0:
            energy[n] = _linear(strain[n], mu, lam, out[n])
        elif law == 1:
            energy[n] = _corotational(f, r, mu, lam, out[n])
        else:
            energy[n] = _neo_hookean(f, r, mu, lam, out[n])


@argument_types("i8, f8[:,:,::1], f8[:,::1], f8, f8[:,:,::1]")
@compiled
def resist_swelling(law: int, strain: Floats, weight: Floats, lam: float, out: Floats) -> float:
    """Adds to `out` (M * Q, 3, 3) kPa the stress of lam/2 times the square of each element's mean swelling,
    and returns its energy, mN mm, infinite where the law is undefined.

    Swelling is the quantity that a law's lambda term squares: tr e, tr(R'F - I) or log J. `law`, `strain`: as
    in `stress`, Q points an element in turn; `weight`: (M, Q) mm^3; `lam`: kPa.
    """
    elements, points = weight.shape
    f, slope = np.empty((3, 3)), np.empty((points, 3, 3))
    energy = 0.0
    for e in range(elements):
        total, volume = 0.0, 0.0
        for q in range(points):
            _deformation(strain[e * points + q], f)
            swelling = _swelling(law, f, slope[q])
            total += weight[e, q] * swelling
            volume += weight[e, q]
        mean = total / volume
        energy += 0.5 * lam * volume * mean * mean
        for q in range(points):
            for i in range(3):
                for j in range(3):
                    out[e * points + q, i, j] += lam * mean * slope[q, i, j]
    return energy


@inlined
def _deformation(strain: Floats, f: Floats) -> None:
    for i in range(3):
        for j in range(3):
            f[i, j] = strain[i, j]
        f[i, i] += 1


@inlined
def _swelling(law: int, f: Floats, slope: Floats) -> float:
    """Swelling at F; `slope` receives its derivative. Infinite where undefined."""
    if law == 0 or law == 1:
        if law == 1:
            _rotation(f, slope)
        total = -3.0
        for i in range(3):
            for j in range(3):
                if law == 0:
                    slope[i, j] = 1.0 if i == j else 0.0
                total += slope[i, j] * f[i, j]
        return total
    det = _det(f)
    _cofactor(f, slope)
    for i in range(3):
        for j in range(3):
            slope[i, j] = slope[i, j] / det if det > 0 else 0.0
    return np.log(det) if det > 0 else np.inf  # type: ignore[no-any-return]


def least_determinant(strain: Floats) -> tuple[float, int]:
    """Smallest det F of (n, 3, 3) displacement gradients F - I, and its index."""
    a, b, c = np.moveaxis(strain + np.eye(3), 0, -1)
    det = a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0])
    det += a[2] * (b[0] * c[1] - b[1] * c[0])
    index = int(np.nanargmin(det)) if not np.isnan(det).all() else 0
    return float(det[index]), index


@inlined
def _linear(h: Floats, mu: float, lam: float, p: Floats) -> float:
    trace, squares = h[0, 0] + h[1, 1] + h[2, 2], 0.0
    for i in range(3):
        for j in range(3):
            e = 0.5 * (h[i, j] + h[j, i])
            squares += e * e
            p[i, j] = 2 * mu * e
        p[i, i] += lam * trace
    return mu * squares + 0.5 * lam * trace * trace  # type: ignore[no-any-return]


@inlined
def _corotational(f: Floats, r: Floats, mu: float, lam: float, p: Floats) -> float:
    _rotation(f, r)
    trace, squares = -3.0, 0.0
    for i in range(3):
        for j in range(3):
            trace += r[i, j] * f[i, j]
            squares += (f[i, j] - r[i, j]) ** 2
    for i in range(3):
        for j in range(3):
            p[i, j] = 2 * mu * (f[i, j] - r[i, j]) + lam * trace * r[i, j]
    return mu * squares + 0.5 * lam * trace * trace


@inlined
def _neo_hookean(f: Floats, c: Floats, mu: float, lam: float, p: Floats) -> float:
    det = _det(f)
    if not det > 0:
        for i in range(3):
            for j in range(3):
                p[i, j] = 0.0
        return np.inf
    _cofactor(f, c)
    log = np.log(det)
    out, squares = (lam * log - mu) / det, 0.0
    for i in range(3):
        for j in range(3):
            squares += f[i, j] * f[i, j]
            p[i, j] = mu * f[i, j] + out * c[i, j]
    return 0.5 * mu * (squares - 3) - mu * log + 0.5 * lam * log * log  # type: ignore[no-any-return]


@inlined
def _det(f: Floats) -> float:
    return (  # type: ignore[no-any-return]
        f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1])
        - f[0, 1] * (f[1, 0] * f[2, 2] - f[1, 2] * f[2, 0])
        + f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0])
    )


@inlined
def _cofactor(f: Floats, c: Floats) -> None:
    for i in range(3):
        for j in range(3):
            a, b, k, m = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            c[i, j] = f[a, k] * f[b, m] - f[a, m] * f[b, k]


@inlined
def _rotation(f: Floats, r: Floats) -> None:
    """Rotation of the polar decomposition, by Newton's iteration (Higham, SIAM J. Sci. Stat. Comp. 7, 1986).

    For an inside-out F it ends at a reflection; no harm, since the frame is rejected for its determinant.
    """
    # Scalars, as nine elements stay in registers: four times as fast as a loop over an array.
    a, b, c = f[0, 0], f[0, 1], f[0, 2]
    d, e, g = f[1, 0], f[1, 1], f[1, 2]
    h, k, m = f[2, 0], f[2, 1], f[2, 2]
    for _ in range(40):
        # Cofactors.
        ca, cb, cc = e * m - g * k, g * h - d * m, d * k - e * h
        cd, ce, cg = c * k - b * m, a * m - c * h, b * h - a * k
        ch, ck, cm = b * g - c * e, c * d - a * g, a * e - b * d
        det = a * ca + b * cb + c * cc
        if abs(det) < 1e-300:
            break
        half = 0.5 / det
        da, db, dc = half * ca - 0.5 * a, half * cb - 0.5 * b, half * cc - 0.5 * c
        dd, de, dg = half * cd - 0.5 * d, half * ce - 0.5 * e, half * cg - 0.5 * g
        dh, dk, dm = half * ch - 0.5 * h, half * ck - 0.5 * k, half * cm - 0.5 * m
        a, b, c, d, e, g, h, k, m = a + da, b + db, c + dc, d + dd, e + de, g + dg, h + dh, k + dk, m + dm
        square = da * da + db * db + dc * dc + dd * dd + de * de + dg * dg + dh * dh + dk * dk + dm * dm
        if square < 1e-18:  # the change squares itself: the next step would be 1e-18
            break
    r[0, 0], r[0, 1], r[0, 2] = a, b, c
    r[1, 0], r[1, 1], r[1, 2] = d, e, g
    r[2, 0], r[2, 1], r[2, 2] = h, k, m
