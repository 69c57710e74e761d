"""The stiffness at a deformed state, as a preconditioner of the search for the next one.

Where tissue has stiffened tenfold, the stiffness at rest is a poor guide: the search takes hundreds of steps.
That at a state nearby takes one factorisation and a few steps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from synth.arrays import Floats
from synth.fem import foreign_law, ogden
from synth.fem.assembly import gradient, stiffness
from synth.fem.laws import NUMBER, lame, stress
from synth.fem.system import System, factorise

_STEP = 1e-6  # of finite differences, in strain
_SMALL_STRAIN = "linear", "corotational"  # laws whose stiffness hardly changes in their range


def linearise(system: System, u: Floats) -> System:
    """The system with the stiffness at (N, 3) mm in place of that at rest, negative curvature of the law cut
    off so that it stays positive definite; itself under a law of small strain. J must be above 0 there."""
    if system.law in _SMALL_STRAIN:
        return system
    mesh = system.mesh
    strain = np.empty((mesh.weight.size, 3, 3))
    gradient(mesh.cells, mesh.slope, u, strain)
    f = strain + np.eye(3)
    weight, swelling = mesh.weight, np.log(np.linalg.det(f)).reshape(mesh.weight.shape)
    volume = weight.sum(axis=1)
    mean = np.einsum("eq,eq->e", weight, swelling) / volume
    pressure = np.repeat(system.averaged * mean, weight.shape[1])
    moduli, swelling_gradient = positive_tangent(system, strain, pressure), None
    if system.averaged:
        slope = np.linalg.inv(f).swapaxes(1, 2).reshape(*weight.shape, 3, 3)
        swelling_gradient = np.einsum("eq,eqij,eqnj->eni", weight, slope, mesh.slope, optimize=True)
        swelling_gradient *= np.sqrt(system.averaged / volume)[:, None, None]
    matrix = stiffness(mesh, moduli, swelling_gradient) + sp.kron(system.hold, np.eye(3), format="csr")
    if system.slip is not None:
        matrix = matrix + system.slip
    if system.membrane is not None:
        matrix = matrix + system.membrane.stiffness_at(u)
    matrix = sp.csr_array(matrix)
    return replace(system, stiffness=matrix, factor=factorise(matrix, system.free))


def positive_tangent(system: System, strain: Floats, pressure: Floats) -> Floats:
    """dP/dF (n, 3, 3, 3, 3) kPa of the system's law and of an energy p log J at displacement gradients
    (n, 3, 3), without its negative eigenvalues. `pressure`: p, (n,) kPa."""
    (mu, lam), averaged = lame(1.0, system.poisson), system.averaged
    if system.law == "ogden":
        return ogden.tangent(strain, mu, lam - averaged, system.alpha, pressure, positive=True)

    def evaluate_piola(h: Floats) -> Floats:
        piola, density = np.empty_like(h), np.empty(len(h))
        if system.law in NUMBER:
            stress(NUMBER[system.law], h, mu, lam - averaged, piola, density)
        else:
            foreign_law.stress(system.law, h, mu, lam - averaged, piola, density)
        return piola + pressure[:, None, None] * np.linalg.inv(h + np.eye(3)).swapaxes(1, 2)

    out = np.empty((len(strain), 9, 9))
    for k in range(9):
        step = np.zeros(9)
        step[k] = _STEP
        change = evaluate_piola(strain + step.reshape(3, 3)) - evaluate_piola(strain - step.reshape(3, 3))
        out[:, :, k] = change.reshape(-1, 9) / (2 * _STEP)
    eigenvalues, eigenvectors = np.linalg.eigh(0.5 * (out + out.swapaxes(1, 2)))
    out = (eigenvectors * np.maximum(eigenvalues, 0)[:, None]) @ eigenvectors.swapaxes(1, 2)
    return np.asarray(out.reshape(-1, 3, 3, 3, 3))
