"""A material law of your own: tissue that stiffens exponentially, compared with neo-Hookean under a pull.

    python examples/own_law.py

The energy is W = mu/(2b) (exp(b (tr C - 3 - 2 log J)) - 1) + lambda/2 (log J)^2: neo-Hookean for b -> 0
(after H. Demiray, "A note on the elasticity of soft biological tissues", J. Biomechanics 5, 1972).

In an installed package this entry point makes it a job's `fem.law`:

    [project.entry-points."sulcus.law"]
    stiffening = "own_law:Stiffening"
"""

from __future__ import annotations

import numpy as np

import synth


class Stiffening:
    """Exponentially stiffening tissue, whose stiffness at rest is that of the other laws."""

    largest_load = 0.3
    """Largest P = F/(E a^2) that jobs may use."""

    def __init__(self, b: float = 2.0) -> None:
        self.b = b

    def stress(self, f: np.ndarray, mu: float, lam: float) -> tuple[np.ndarray, np.ndarray]:
        """Energy (n,) and first Piola-Kirchhoff stress dW/dF (n, 3, 3) [kPa] at gradients F (n, 3, 3)."""
        j = np.linalg.det(f)
        log = np.log(np.where(j > 0, j, np.nan))
        inverse_t = np.linalg.inv(f).transpose(0, 2, 1)
        stretch = np.exp(self.b * (np.einsum("nij,nij->n", f, f) - 3 - 2 * log))
        energy = mu / (2 * self.b) * (stretch - 1) + lam / 2 * log**2
        first = (mu * stretch)[:, None, None] * (f - inverse_t) + (lam * log)[:, None, None] * inverse_t
        return np.where(j > 0, energy, np.inf), np.nan_to_num(first)


def peak_mm(law: str, load: float = 0.3) -> float:
    """Largest displacement of the surface [mm] under a pull of P = F/(E a^2) = `load`."""
    pull = {"gestures": ["pull"], "load": load, "law": law, "tets": 400}
    job = synth.Job.model_validate({"seed": 1, "frames": 5, "anatomy": {"vertices": 2500}, "fem": pull})
    return float(np.linalg.norm(synth.simulate(job, 0).motion.displacement, axis=2).max())


if __name__ == "__main__":
    print("neo-Hookean", f"{peak_mm('neo-hookean'):.2f} mm")
    for b in (1.0, 4.0):
        synth.add_law(f"stiffening-{b:g}", Stiffening(b))  # in this process, without a package
        print(f"b = {b:g}", f"{peak_mm(f'stiffening-{b:g}'):.2f} mm")
