"""A material law of one's own: tissue that stiffens exponentially, against neo-Hookean, under one pull.

    python examples/own_law.py

The energy is W = mu/(2b) (exp(b (tr C - 3 - 2 log J)) - 1) + lambda/2 (log J)^2: neo-Hookean for b -> 0
(after H. Demiray, "A note on the elasticity of soft biological tissues", J. Biomechanics 5, 1972).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.fem import equilibrium, surface_embedding, tool
from synth.fem.assembly import divergence, gradient
from synth.fem.laws import lame
from synth.fem.mesh import tetrahedra
from synth.fem.system import State, System, assemble
from synth.job.schema import Anatomy

Floats = NDArray[np.float64]


def stress(f: Floats, b: float, mu: float, lam: float) -> tuple[Floats, Floats]:
    """Energy (n,) and first Piola-Kirchhoff stress dW/dF (n, 3, 3) [kPa] at gradients F (n, 3, 3)."""
    j = np.linalg.det(f)
    log = np.log(np.where(j > 0, j, np.nan))
    turned = np.linalg.inv(f).transpose(0, 2, 1)
    stretch = np.exp(b * (np.einsum("nij,nij->n", f, f) - 3 - 2 * log))
    energy = mu / (2 * b) * (stretch - 1) + lam / 2 * log**2
    first = (mu * stretch)[:, None, None] * (f - turned) + (lam * log)[:, None, None] * turned
    return np.where(j > 0, energy, np.inf), np.nan_to_num(first)


@dataclass(frozen=True)
class Stiffening(System):
    """The equations of a brain with that law; at rest it is as stiff as the others."""

    b: float = 2.0

    def state(self, u: Floats) -> State:
        strain = np.empty((self.mesh.weight.size, 3, 3))
        gradient(self.mesh.cells, self.mesh.slope, u, strain)
        f = strain + np.eye(3)
        energy, first = stress(f, self.b, *lame(1.0, self.poisson))
        force = np.empty_like(u)
        divergence(self.mesh.cells, self.mesh.slope, self.mesh.weight, first, force)
        spring = self.hold @ u  # of the skull
        whole = float(energy @ self.mesh.weight.ravel()) + 0.5 * float(np.vdot(u, spring))
        return State(whole, force + spring, float(np.linalg.det(f).min()))


def peak_mm(b: float | None, load: float = 0.3, radius_mm: float = 5.0) -> float:
    """Largest displacement under a pull of P = F/(E a^2) = `load`; `b` None is neo-Hookean."""
    tets = tetrahedra.block(Anatomy(), 400, 2, [(0.0, 0.0, radius_mm)])
    system = assemble(tets, "neo-hookean", 0.4)
    if b is not None:
        system = Stiffening(**vars(system), b=b)
    # The surface that is loaded: a dense patch, which the volume carries by B and answers to by B'.
    xy = np.stack(np.meshgrid(*2 * [np.linspace(-15, 15, 61)]), axis=-1).reshape(-1, 2)
    vertices = np.column_stack([xy, tetrahedra.dome(xy, Anatomy().dome_mm)])
    area = np.full(len(vertices), 0.25)
    pressure = tool.footprint(np.zeros(2), radius_mm, vertices, area) * load * radius_mm**2  # E = 1 kPa
    carry = surface_embedding.embed(tets, vertices)
    pull = carry.gather(np.outer(area * pressure, [0.0, 0.0, 1.0]))
    course = np.linspace(0, 1, 5)
    path = equilibrium.solve_path(system, course[:, None, None] * pull, course * load)
    return float(np.linalg.norm(carry.move(path.displacement[-1]), axis=1).max())


if __name__ == "__main__":
    for b in (None, 1.0, 4.0):
        print("neo-Hookean" if b is None else f"b = {b:g}", f"{peak_mm(b):.2f} mm")
