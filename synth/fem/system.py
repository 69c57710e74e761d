"""The equations of one brain for E = 1 kPa: stiffness at rest, factored once, and the forces of a law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu

from synth.arrays import Floats, Ints
from synth.errors import UserError
from synth.fem import foreign_law, ogden
from synth.fem.assembly import divergence, gradient, stiffness
from synth.fem.laws import NUMBER, lame, least_determinant, resist_swelling, stress
from synth.fem.membrane import Membrane, MembraneSheet, cover
from synth.fem.mesh.element import Quadrature, quadrature, quality
from synth.fem.mesh.tetrahedra import Tets

_FLATTEST = 0.01  # mean ratio; measured: one sliver of 0.002 under a contact takes a quarter of the motion

POINTWISE = 1.0
"""Part of lambda, in units of mu, that acts at quadrature points; the remainder acts on elements' means,
against locking (Nagtegaal, Parks & Rice, Comput. Meth. Appl. Mech. Eng. 4, 1974). Chosen on discs pressed
into a half-space at nu 0.49: radial motion next to the disc is off by a quarter at 1,600 to 5,000 tetrahedra;
with all of lambda at points by twice its own size, with none by 60%.
docs/results/fem checks it on a block that was not used for this choice."""


@dataclass(frozen=True)
class State:
    """Energy and forces of a displacement, for E = 1 kPa."""

    energy: float  # mN mm, stored in tissue, membrane and springs
    force: Floats  # (N, 3) mN of resistance by tissue, membrane and springs


@dataclass(frozen=True)
class System:
    """A meshed brain of one law. All forces and energies are for E = 1 kPa; displacement needs no scaling."""

    mesh: Quadrature
    law: str
    poisson: float
    free: Ints  # (D,) degrees of freedom that can move
    hold: sp.csr_array  # (N, N) mN/mm, as in `Tets`
    stiffness: sp.csr_array  # (3N, 3N) mN/mm at rest, springs and membrane included
    factor: SuperLU  # of the free part of `stiffness`
    corners: Quadrature  # the same mesh with the elements' corners as points
    membrane: Membrane | None = None  # on its surface
    averaged: float = 0.0  # kPa, the part of lambda that acts on elements' mean swelling, see `POINTWISE`
    slip: sp.csr_array | None = None  # (3N, 3N) mN/mm, as in `Tets`
    alpha: float = ogden.ALPHA  # exponent of Ogden's law

    def solve(self, force: Floats) -> Floats:
        """Displacement of the linear law, (N, 3) mm, under (N, 3) mN; of K loads at once, (N, 3, K) each."""
        rows = force.reshape(3 * len(force), *force.shape[2:])
        u = np.zeros_like(rows, np.float64)
        u[self.free] = self.factor.solve(np.asfortranarray(rows[self.free]))
        return u.reshape(force.shape)

    def state(self, u: Floats) -> State:
        """Energy and forces at (N, 3) mm."""
        strain = _strain(self.mesh, u)
        piola, energy = self._stress(strain)
        force = np.empty_like(u)
        divergence(self.mesh.cells, self.mesh.slope, self.mesh.weight, piola, force)
        spring = self.springs(u)
        energy += 0.5 * float(np.vdot(u, spring))
        force += spring
        if self.membrane is not None:
            energy += self.membrane.pull(u, force)
        return State(energy, force)

    def cauchy(self, u: Floats) -> Floats:
        """Stress (N, 6) xx yy zz xy yz xz for E = 1 kPa at (N, 3) mm: a node's elements, by volume."""
        strain = _strain(self.mesh, u)
        sigma = self._stress(strain)[0]
        if self.law != "linear":  # which knows one stress, of small strain
            f = strain + np.eye(3)
            sigma = sigma @ f.swapaxes(1, 2) / np.linalg.det(f)[:, None, None]
        cells, weight = self.mesh.cells, self.mesh.weight
        parts = sigma[:, [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]].reshape(*weight.shape, 6)
        total, volume = np.zeros((len(u), 6)), np.zeros(len(u))
        np.add.at(total, cells, np.einsum("mq,mqk->mk", weight, parts)[:, None])
        np.add.at(volume, cells, weight.sum(axis=1)[:, None])
        return total / volume[:, None]

    def _stress(self, strain: Floats) -> tuple[Floats, float]:
        """First Piola-Kirchhoff stress (M * Q, 3, 3) kPa and energy mN mm at displacement gradients."""
        (mu, lam), weight = lame(1.0, self.poisson), self.mesh.weight
        piola, density = np.empty_like(strain), np.empty(len(strain))
        if self.law == "ogden":
            ogden.stress(strain, mu, lam - self.averaged, self.alpha, piola, density)
        elif self.law in NUMBER:
            stress(NUMBER[self.law], strain, mu, lam - self.averaged, piola, density)
        else:
            foreign_law.stress(self.law, strain, mu, lam - self.averaged, piola, density)
        energy = float(density @ weight.ravel())
        if self.averaged:
            swelling = NUMBER.get(self.law, NUMBER["neo-hookean"])  # of Ogden's and of a plug-in: log J
            energy += resist_swelling(swelling, strain, weight, self.averaged, piola)
        return piola, energy

    def springs(self, u: Floats) -> Floats:
        """Force (N, 3) mN of the springs at (N, 3) mm."""
        pull = self.hold @ u
        return np.asarray(pull if self.slip is None else pull + (self.slip @ u.ravel()).reshape(u.shape))

    def least_jacobian(self, u: Floats) -> tuple[float, int]:
        """Smallest det F at (N, 3) mm and its element, corners included: under a contact it is there."""
        minima = []
        for mesh in (self.mesh, self.corners):
            least, index = least_determinant(_strain(mesh, u))
            minima.append((float(least), int(index) // mesh.weight.shape[1]))
        return min(minima)


def assemble(
    tets: Tets, law: str, poisson: float, sheet: MembraneSheet | None = None, alpha: float = ogden.ALPHA
) -> System:
    """Builds and factors the equations; UserError: the mesh holds a tetrahedron that is flat or inside out.

    `law`: a key of `laws.NUMBER`, ogden, or a plug-in's name; `poisson`: below 0.5; `sheet`: on the surface;
    `alpha`: of Ogden's law.
    """
    shape = quality(tets.points[tets.cells[:, :4]])
    if shape.min() < _FLATTEST:
        flat = f"is flat or inside out (mean ratio {shape.min():.1e})"
        raise UserError(f"the mesh's element {shape.argmin()} {flat}")
    mesh = quadrature(tets.points, tets.cells)
    matrix, mean_lambda = tissue_stiffness(mesh, poisson)
    matrix = (matrix + springs(tets)).tocsr()
    membrane = None if sheet is None else cover(tets, sheet, linear=law == "linear")
    if membrane is not None:
        matrix = (matrix + membrane.rest_stiffness()).tocsr()
    free = np.flatnonzero(np.repeat(~tets.fixed, 3))
    factor = factorise(matrix, free)
    corners = quadrature(tets.points, tets.cells, np.eye(4))
    parts = mesh, law, poisson, free, tets.hold, matrix, factor, corners, membrane, mean_lambda, tets.slip
    return System(*parts, alpha)


def factorise(matrix: sp.csr_array, free: Ints) -> SuperLU:
    """Factor of the free part of a stiffness (3N, 3N), symmetric and positive definite there."""
    # No pivoting, an ordering of A + A'.
    inner, symmetric = matrix[free][:, free].tocsc(), {"SymmetricMode": True}
    return splu(inner, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)


def tissue_stiffness(mesh: Quadrature, poisson: float) -> tuple[sp.csr_array, float]:
    """Stiffness (3N, 3N) mN/mm of the tissue alone at rest, and the part of lambda [kPa] that acts on
    elements' means."""
    mu, lam = lame(1.0, poisson)
    mean_lambda = max(lam - POINTWISE * mu, 0.0)
    swelling_gradient = None
    if mean_lambda:
        slope = np.broadcast_to(np.eye(3), (*mesh.weight.shape, 3, 3))  # the swelling's derivative at rest
        swelling_gradient = np.einsum("eq,eqij,eqnj->eni", mesh.weight, slope, mesh.slope, optimize=True)
        swelling_gradient *= np.sqrt(mean_lambda / mesh.weight.sum(axis=1))[:, None, None]
    moduli = hooke(1.0, poisson)
    moduli -= mean_lambda * np.einsum("ij,km->ijkm", np.eye(3), np.eye(3))
    return stiffness(mesh, moduli, swelling_gradient), mean_lambda


def springs(tets: Tets) -> sp.csr_array:
    """Stiffness (3N, 3N) mN/mm of the skull and of attachments."""
    matrix = sp.kron(tets.hold, np.eye(3), format="csr")
    return sp.csr_array(matrix if tets.slip is None else matrix + tets.slip)


def hooke(young: float, poisson: float) -> Floats:
    """Moduli of Hooke's law, (1, 3, 3, 3, 3) in the unit of `young`: the tangent of every law at rest."""
    (mu, lam), identity = lame(young, poisson), np.eye(3)
    shear = np.einsum("ik,jm->ijkm", identity, identity) + np.einsum("im,jk->ijkm", identity, identity)
    return np.asarray(mu * shear + lam * np.einsum("ij,km->ijkm", identity, identity))[None]


def _strain(mesh: Quadrature, u: Floats) -> Floats:
    """Displacement gradients (M * Q, 3, 3) of a mesh at (N, 3) mm."""
    strain = np.empty((mesh.weight.size, 3, 3))
    gradient(mesh.cells, mesh.slope, u, strain)
    return strain
