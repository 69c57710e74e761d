"""The tissue: how stiff, how compressible, and what load it takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.errors import UserError
from synth.fem.membrane import Sheet
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.system import System, assemble
from synth.job import schema
from synth.job.laws import largest_load

_STRETCH = 1.01, 1.03
"""How far a membrane is stretched at rest. Not from a measurement: its pull then balances a pressure of 3-350
Pa (at most 2.6 mmHg) under a dome of 70 mm radius, which a living head has."""


@dataclass(frozen=True)
class Pia:
    """What is drawn for an intact membrane."""

    young_kpa: float
    """Young's modulus at small strain."""
    thickness_mm: float
    stretch: float
    """At rest."""


@dataclass(frozen=True)
class Tissue:
    """What is drawn for the tissue of one sequence."""

    young_kpa: float
    """Young's modulus E."""
    poisson: float
    """Poisson's ratio."""
    law: str
    """Material law, a key of `laws.NUMBER` or a plug-in's name."""
    why: str = "asked for"
    """Why this law."""
    membrane: Pia | None = None
    """The membrane on the surface; None where it is stripped."""
    skull: str = "bonded"
    """`bonded` or `slip`."""

    @classmethod
    def draw(cls, fem: schema.Fem, rng: np.random.Generator) -> Tissue:
        """E log-uniformly: half as stiff and twice as stiff are as likely."""
        law, why = fem.chosen_law
        young = _draw_log_uniform(fem.young_kpa, rng)
        # Drawn whether it counts or not, so that no number depends on whether another is asked for.
        asked, intact = fem.membrane, rng.uniform()
        stiff, thick, stretch = (
            _draw_log_uniform(asked.young_kpa, rng),
            float(rng.uniform(*asked.thickness_mm)),
            float(rng.uniform(*_STRETCH)),
        )
        pia = Pia(stiff, thick, stretch)
        poisson, skull = float(rng.uniform(*fem.poisson)), str(rng.choice(fem.skull))
        return cls(young, poisson, law, why, pia if intact < asked.intact else None, skull)

    def equations(self, tets: Tets, law: str | None = None) -> System:
        """The equations of a volume of it, of its own law or another."""
        return assemble(tets, law or self.law, self.poisson, self.sheet)

    @property
    def sheet(self) -> Sheet | None:
        """The membrane on tissue of E = 1 kPa."""
        pia = self.membrane
        if pia is None:
            return None
        return Sheet(pia.young_kpa * pia.thickness_mm / self.young_kpa, pia.stretch)


def _draw_log_uniform(ends: tuple[float, float], rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(*np.log(ends))))


def check_load(law: str, load: float) -> None:
    """Refuses a load past what a law is known to describe.

    Args:
        law: its name.
        load: P = F/(E a^2).

    Raises:
        UserError: names the largest valid value.
    """
    largest = largest_load(law)
    if load > largest * (1 + 1e-9):  # a force turned into a load may be off by rounding
        raise UserError(
            f"fem.load: {load:g} is past the range of the {law} law; the largest valid value is {largest:g}"
        )
