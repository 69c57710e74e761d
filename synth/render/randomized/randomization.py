"""Randomisation of one sequence: what neither a job's keys nor an appearance express."""

from __future__ import annotations

from dataclasses import dataclass

from synth.render.appearance.family import Colour
from synth.render.randomized.pattern import Pattern
from synth.render.randomized.surroundings import Surroundings


@dataclass(frozen=True)
class Randomization:
    """Numbers drawn for groups of `Job.randomize`; those of a group that is off are as here."""

    scale: float = 1.0  # of the tissue: mm in a mm of the patch as it is grown and painted
    pattern: Pattern | None = None  # on the tissue; None: a painted cortex, or the job's photograph
    tint: Colour = (1.0, 1.0, 1.0)  # linear RGB of a cortex or photograph
    tinted: float = 0.0  # share of its colour that the tint replaces
    surroundings: Surroundings | None = None  # None: the rim of a craniotomy
