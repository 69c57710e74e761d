"""The tissue: how stiff, how compressible, and what load it takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.errors import UserError
from synth.job import schema
from synth.job.law_limits import LARGEST_LOAD, choose


@dataclass(frozen=True)
class Tissue:
    """What is drawn for the tissue of one sequence."""

    young_kpa: float
    """Young's modulus E."""
    poisson: float
    """Poisson's ratio."""
    law: str
    """Material law, a key of `laws.NUMBER`."""
    why: str = "asked for"
    """Why this law."""

    @classmethod
    def draw(cls, fem: schema.Fem, rng: np.random.Generator) -> Tissue:
        """E log-uniformly: half as stiff and twice as stiff are as likely."""
        low, high = np.log(fem.young_kpa)
        law, why = choose(fem.law, fem.largest_load, fem.tolerance)
        return cls(float(np.exp(rng.uniform(low, high))), fem.poisson, law, why)


def check_load(law: str, load: float) -> None:
    """Refuses a load past what a law is known to describe.

    Args:
        law: a key of `LARGEST_LOAD`.
        load: P = F/(E a^2).

    Raises:
        UserError: names the largest valid value.
    """
    largest = LARGEST_LOAD[law]
    if load > largest * (1 + 1e-9):  # a force turned into a load may be off by rounding
        raise UserError(
            f"fem.load: {load:g} is past the range of the {law} law; the largest valid value is {largest:g}"
        )
