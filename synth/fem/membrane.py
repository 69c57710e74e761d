"""A thin stiff sheet on the surface of the volume: the pia-arachnoid as a membrane.

Incompressible neo-Hookean under plane stress. With C the surface's metric over its rest metric, det C its
squared area, S the thickness times Young's modulus,

    W = S/6 (tr C + 1/det C - 3)    a unit of area at rest, mN/mm,

at small strain S/3 (e:e + (tr e)^2). A sheet so thin wrinkles rather than bear compression, so W is its
relaxed energy (Pipkin, IMA J. Appl. Math. 36, 1986): where the smaller principal stretch falls below that of
uniaxial tension, S/6 (c + 2/sqrt(c) - 3) of the larger squared stretch c, and 0 where that is below 1.

Collagen that is wavy at rest stiffens as it straightens: with X the bracket above, S/6 X becomes

    W = S/(6 b) (exp(b X) - 1)    (Demiray, J. Biomech. 5, 1972, of Fung's kind),

which wrinkles where the sheet of b = 0 does, as it rises with X. A strip then bears S/3 (l - 1/l^2) exp(b X)
at a stretch l: at b = 30 it is five times as stiff at a strain of 0.1 as at rest.

At rest it is pre-stretched, as in a living head; the pressure inside balances that as a constant load.
Measured: without pre-stretch the sheet is slack one way and stiff the other, and the solver takes several
times as long; a sheet that resists compression buckles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from synth.arrays import Floats, Indices
from synth.fem.mesh.element import scatter_blocks, shape_slope
from synth.fem.mesh.tetrahedra import Tets, boundary
from synth.system.jit import compiled, inlined

_POINTS = np.full((3, 3), 1 / 6) + 0.5 * np.eye(3)
"""Barycentric quadrature points of degree 2, of equal weight: exact at small strain for flat faces."""

_LARGEST_POWER = 300.0  # of exp: beyond it an energy would overflow


@dataclass(frozen=True)
class MembraneSheet:
    """Parameters of a membrane, on tissue of E = 1 kPa."""

    stiffness: float  # mN/mm: thickness times Young's modulus
    stretch: float  # pre-stretch at rest, the same in every direction; above 1
    stiffening: float = 0.0  # b of its energy; 0: neo-Hookean


@dataclass(frozen=True)
class Membrane:
    """A membrane on F faces of the surface, with Q quadrature points and n nodes each."""

    faces: Indices  # (F, n) nodes
    slope: Floats  # (F, Q, n, 2) 1/mm, of the shape functions along the two rest tangents
    tangent: Floats  # (F, Q, 3, 2) orthonormal tangents at rest
    weight: Floats  # (F, Q) mm^2 at rest
    stiffness: float  # mN/mm: thickness times Young's modulus
    linear: bool  # small strain, with resistance to compression: goes with a volume of the linear law
    square: float  # squared stretch at rest
    stiffening: float  # b of its energy
    balance: Floats  # (N, 3) mN: its force at rest, which the pressure inside balances
    stored: float  # mN mm, its energy at rest

    def pull(self, u: Floats, out: Floats) -> float:
        """Adds its forces at (N, 3) mm to (N, 3) mN, and returns its energy, mN mm; both are 0 at rest."""
        mesh = self.faces, self.slope, self.tangent, self.weight
        energy = float(_pull(*mesh, u, self.stiffness, self.linear, self.square, self.stiffening, out))
        out -= self.balance
        return energy - self.stored - float(np.vdot(self.balance, u))

    def rest_stiffness(self) -> sp.csr_array:
        """(3N, 3N) mN/mm at rest, exact; being stretched, it has no wrinkles."""
        return self._stiffness(self.tangent)

    def stiffness_at(self, u: Floats) -> sp.csr_array:
        """(3N, 3N) mN/mm at (N, 3) mm, positive semi-definite: exact but where it begins to wrinkle."""
        return self._stiffness(self.tangent + np.einsum("fqna,fni->fqia", self.slope, u[self.faces]))

    def _stiffness(self, basis: Floats) -> sp.csr_array:
        """At tangents (F, Q, 3, 2) that the sheet has moved."""
        metric = self.square * np.einsum("fqia,fqib->fqab", basis, basis)
        if self.linear:
            stress, moduli = _evaluate_taut(metric)
        else:
            stress, moduli = _evaluate_wrinkling(metric, self.stiffening)
        stress, moduli = self.stiffness * self.square * stress, self.stiffness * self.square**2 * moduli
        metric_slope = np.einsum("fqna,fqib->fqniab", self.slope, basis)
        local = np.einsum(
            "fqniab,fqabcd,fqmjcd,fq->fnimj", metric_slope, moduli, metric_slope, self.weight, optimize=True
        )
        geometric = np.einsum(
            "fqna,fqab,fqmb,fq->fnm", self.slope, stress, self.slope, self.weight, optimize=True
        )
        local += np.einsum("fnm,ij->fnimj", geometric, np.eye(3))
        return scatter_blocks(local, self.faces, len(self.balance))


def cover(tets: Tets, sheet: MembraneSheet, *, linear: bool) -> Membrane:
    """A membrane over a volume's surface but its cut walls; `linear`: small strain, without pre-stretch."""
    membrane = lay(tets, sheet, linear=linear)
    balance = np.zeros_like(tets.points)
    energy = membrane.pull(balance.copy(), balance)
    return replace(membrane, balance=balance, stored=energy)


def lay(tets: Tets, sheet: MembraneSheet, *, linear: bool) -> Membrane:
    """`cover` without the pressure that balances it, for its stiffness at rest."""
    faces = boundary(tets.cells)
    faces = faces[~tets.fixed[faces].all(axis=1)]
    local = shape_slope(_POINTS)
    side = np.einsum("qnk,fni->fqik", local, tets.points[faces])
    first = side[..., 0] / np.linalg.norm(side[..., 0], axis=-1, keepdims=True)
    normal = np.cross(side[..., 0], side[..., 1])
    area = np.linalg.norm(normal, axis=-1)
    tangent = np.stack([first, np.cross(normal / area[..., None], first)], axis=-1)
    mapping = np.linalg.inv(np.einsum("fqia,fqik->fqak", tangent, side))
    return Membrane(
        faces.astype(np.int32),
        np.ascontiguousarray(np.einsum("qnk,fqka->fqna", local, mapping)),
        np.ascontiguousarray(tangent),
        area / (2 * len(_POINTS)),
        sheet.stiffness,
        linear,
        1.0 if linear else sheet.stretch**2,
        sheet.stiffening,
        np.zeros_like(tets.points),
        0.0,
    )


@compiled
def _pull(
    faces: Indices,
    slope: Floats,
    tangent: Floats,
    weight: Floats,
    u: Floats,
    stiffness: float,
    linear: bool,
    square: float,
    stiffening: float,
    out: Floats,
) -> float:
    """Adds the forces of the whole sheet, stretch at rest included, and returns its energy."""
    count, points, nodes, _ = slope.shape
    energy = 0.0
    gradient, basis = np.empty((3, 2)), np.empty((3, 2))
    for f in range(count):
        for q in range(points):
            for i in range(3):
                gradient[i, 0] = gradient[i, 1] = 0.0
            for n in range(nodes):
                a, b = slope[f, q, n, 0], slope[f, q, n, 1]
                for i in range(3):
                    v = u[faces[f, n], i]
                    gradient[i, 0] += v * a
                    gradient[i, 1] += v * b
            if linear:
                xx, yy, xy = 0.0, 0.0, 0.0
                for i in range(3):
                    basis[i, 0], basis[i, 1] = tangent[f, q, i, 0], tangent[f, q, i, 1]
                    xx += basis[i, 0] * gradient[i, 0]
                    yy += basis[i, 1] * gradient[i, 1]
                    xy += 0.5 * (basis[i, 0] * gradient[i, 1] + basis[i, 1] * gradient[i, 0])
                trace = xx + yy
                density = (xx * xx + yy * yy + 2 * xy * xy + trace * trace) / 3
                sxx, syy, sxy = 2 / 3 * (xx + trace), 2 / 3 * (yy + trace), 2 / 3 * xy
            else:
                xx, yy, xy = 0.0, 0.0, 0.0
                for i in range(3):
                    basis[i, 0] = tangent[f, q, i, 0] + gradient[i, 0]
                    basis[i, 1] = tangent[f, q, i, 1] + gradient[i, 1]
                    xx += basis[i, 0] * basis[i, 0]
                    yy += basis[i, 1] * basis[i, 1]
                    xy += basis[i, 0] * basis[i, 1]
                density, sxx, syy, sxy = _stretch(square * xx, square * yy, square * xy)
                growth = square
                if stiffening > 0:
                    power = np.exp(min(6 * stiffening * density, _LARGEST_POWER))
                    density, growth = (power - 1) / (6 * stiffening), square * power
                sxx, syy, sxy = growth * sxx, growth * syy, growth * sxy
            w = weight[f, q] * stiffness
            energy += w * density
            for n in range(nodes):
                a, b = slope[f, q, n, 0], slope[f, q, n, 1]
                along, aside = w * (sxx * a + sxy * b), w * (sxy * a + syy * b)
                for i in range(3):
                    out[faces[f, n], i] += basis[i, 0] * along + basis[i, 1] * aside
    return energy


@inlined
def _stretch(xx: float, yy: float, xy: float) -> tuple[float, float, float, float]:
    """Energy and second Piola-Kirchhoff stress (xx, yy, xy) at the metric C, for S = 1."""
    det = xx * yy - xy * xy
    half = 0.5 * (xx - yy)
    away = np.sqrt(half * half + xy * xy)
    large = 0.5 * (xx + yy) + away
    if large <= 1.0:
        return 0.0, 0.0, 0.0, 0.0
    if det < np.sqrt(large):  # the smaller stretch is below that of uniaxial tension
        pull = (1 - large**-1.5) / 6
        c, s = half / away, xy / away  # cosine and sine of twice the angle to the larger stretch
        return (large + 2 / np.sqrt(large) - 3) / 6, pull * (1 + c), pull * (1 - c), pull * s
    over = 1 / (det * det)
    energy = (xx + yy + 1 / det - 3) / 6
    return energy, (1 - yy * over) / 3, (1 - xx * over) / 3, xy * over / 3


def _evaluate_taut(metric: Floats) -> tuple[Floats, Floats]:
    """Second Piola-Kirchhoff stress (..., 2, 2) and its derivative by strain at the metric C, for S = 1, of a
    neo-Hookean sheet without wrinkles."""
    inverse, det = np.linalg.inv(metric), np.linalg.det(metric)[..., None, None]
    stress = (np.eye(2) - inverse / det) / 3
    crossing = np.einsum("...ac,...bd->...abcd", inverse, inverse)
    crossing = 0.5 * (crossing + np.swapaxes(crossing, -1, -2))
    product = np.einsum("...ab,...cd->...abcd", inverse, inverse) + crossing
    return stress, 2 / 3 * product / det[..., None, None]


def _evaluate_wrinkling(metric: Floats, stiffening: float) -> tuple[Floats, Floats]:
    """As `_evaluate_taut`, of a sheet that stiffens and wrinkles."""
    squares, eigenvectors = np.linalg.eigh(metric)
    small, large = squares[..., 0], np.maximum(squares[..., 1], 1.0)  # below 1 it is slack: 0, as at 1
    stress, moduli = _evaluate_taut(metric)
    excess = np.trace(metric, axis1=-2, axis2=-1) + 1 / (small * squares[..., 1]) - 3
    major, minor = eigenvectors[..., 1], eigenvectors[..., 0]
    line = major[..., :, None] * major[..., None, :]
    shear = major[..., :, None] * minor[..., None, :]
    shear = shear + np.swapaxes(shear, -1, -2)
    pull = (1 - large**-1.5) / 3  # of a strip
    curve = np.where(squares[..., 1] > 1, large**-2.5, 0.0)
    gap = np.maximum(squares[..., 1] - small, 1e-12)  # where it wrinkles, the stretches differ
    wrinkled_moduli = curve[..., None, None, None, None] * np.einsum("...ab,...cd->...abcd", line, line)
    wrinkled_moduli = wrinkled_moduli + (pull / gap)[..., None, None, None, None] * np.einsum(
        "...ab,...cd->...abcd", shear, shear
    )
    wrinkled = small * squares[..., 1] < np.sqrt(large)
    stress = np.where(wrinkled[..., None, None], pull[..., None, None] * line, stress)
    moduli = np.where(wrinkled[..., None, None, None, None], wrinkled_moduli, moduli)
    if stiffening > 0:
        excess = np.where(wrinkled, large + 2 / np.sqrt(large) - 3, excess)
        power = np.exp(np.minimum(stiffening * excess, _LARGEST_POWER))[..., None, None]
        moduli = moduli + 6 * stiffening * np.einsum("...ab,...cd->...abcd", stress, stress)
        stress, moduli = power * stress, power[..., None, None] * moduli
    return stress, moduli
