"""One instrument of a job, where and as it is asked for."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, model_validator

from synth.job.types import PositiveRange, Section, Vector

Kind = Literal["pull", "push", "slide", "grasp", "retract", "tap"]

CLEAR_MM = 1.0
"""How far a contact stays clear of the rim."""

_Part = Annotated[FiniteFloat, Field(gt=0, lt=1)]


class InstrumentSection(Section):
    """One instrument as asked; what is left out is drawn as for the others."""

    gesture: Kind | None = None
    """What it does. Empty: drawn from `fem.gestures`."""
    place: tuple[FiniteFloat, FiniteFloat] | None = None
    """Middle of its contact at rest [mm]: x and y in world axes, from the middle of the opening."""
    direction: Vector | None = None
    """Which way it loads the tissue, in world axes with z out of the brain; normalised. Of a slide x and y
    count: the way it goes. Needs `gesture`."""
    load: PositiveRange | None = None
    """Peak load as P = F/(E a^2)."""
    force_mn: PositiveRange | None = None
    """Peak force of a contact [mN], instead of `load`."""
    footprint_mm: PositiveRange | None = None
    """Radius a of its contact [mm]."""
    timing: tuple[_Part, _Part, _Part, _Part] | None = None
    """Touch, full load, load begins to fall, release: rising parts of the sequence. Of a tap the first and
    the last count."""

    @model_validator(mode="after")
    def _goes_together(self) -> InstrumentSection:
        if self.load is not None and self.force_mn is not None:
            raise ValueError("either load or force_mn, not both")
        if self.timing is not None:
            touch, full, fall, release = self.timing
            if not touch < full <= fall < release:
                raise ValueError("timing: touch, full load, fall and release must follow one another")
        if self.direction is not None:
            self._check_direction(*self.direction)
        return self

    def _check_direction(self, x: float, y: float, z: float) -> None:
        if self.gesture is None:
            raise ValueError("direction needs gesture: a push points inwards, a pull outwards")
        if self.gesture in ("pull", "grasp") and z <= 0:
            raise ValueError(f"direction: a {self.gesture} points out of the brain, z above 0")
        if self.gesture in ("push", "tap") and z >= 0:
            raise ValueError(f"direction: a {self.gesture} points into the brain, z below 0")
        if self.gesture == "retract" and (z > 0 or x == y == 0):
            raise ValueError("direction: a retract goes aside, z not above 0 and x or y not 0")
        if self.gesture == "slide" and x == y == 0:
            raise ValueError("direction: a slide needs x or y, the way it goes")
