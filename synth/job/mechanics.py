"""The job's sections on mechanics: tissue, boundary conditions, instruments and their loads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field, FiniteFloat, ValidationInfo, model_validator

from synth.job.laws import LAWS, LoadRange, check_load_range, choose_law
from synth.job.types import Direction, NonNegative, PlugInName, Positive, Range, Section, Share
from synth.plugins import STORED

Kind = Literal["pull", "push", "slide", "grasp", "retract", "tap"]

CLEAR_MM = 1.0  # least distance of a contact from the rim

_DIRECTIONS: dict[Kind, tuple[str, Callable[[float, float, float], bool]]] = {
    "pull": ("points out of the brain, z above 0", lambda x, y, z: z > 0),
    "grasp": ("points out of the brain, z above 0", lambda x, y, z: z > 0),
    "push": ("points into the brain, z below 0", lambda x, y, z: z < 0),
    "tap": ("points into the brain, z below 0", lambda x, y, z: z < 0),
    "retract": (
        "points sideways, z not above 0 and x or y not 0",
        lambda x, y, z: z <= 0 and not x == y == 0,
    ),
    "slide": ("needs x or y, the direction of its motion", lambda x, y, z: not x == y == 0),
}
"""Rule for the direction of each gesture's load, and its test; z points out of the brain."""

_Part = Annotated[FiniteFloat, Field(gt=0, lt=1)]


class InstrumentSection(Section):
    """One instrument with given properties; keys left out are drawn at random."""

    gesture: Kind | None = None
    """Kind of gesture. Empty: drawn from `fem.gestures`."""
    place: tuple[FiniteFloat, FiniteFloat] | None = None
    """Centre of its contact at rest [mm]: x and y in world axes, from the centre of the opening."""
    direction: Direction | None = None
    """Direction of the load, in world axes with z out of the brain; normalised. For a slide, x and y are the
    direction of its motion. Needs `gesture`."""
    load: Range[Positive] | None = None
    """Peak load as P = F/(E a^2)."""
    force_mn: Range[Positive] | None = None
    """Peak force of a contact [mN], instead of `load`."""
    footprint_mm: Range[Positive] | None = None
    """Radius a of its contact [mm]."""
    timing: tuple[_Part, _Part, _Part, _Part] | None = None
    """Touch, full load, beginning of the unloading, release: rising fractions of the sequence. For a tap only
    the first and the last are used."""

    @model_validator(mode="after")
    def _goes_together(self) -> InstrumentSection:
        if self.load is not None and self.force_mn is not None:
            raise ValueError("either load or force_mn, not both")
        if self.timing is not None:
            touch, full, fall, release = self.timing
            if not touch < full <= fall < release:
                raise ValueError("timing: touch, full load, fall and release must follow one another")
        if self.direction is not None and self.gesture is None:
            raise ValueError("direction needs gesture: that of a push points inwards, of a pull outwards")
        if self.direction is not None and self.gesture is not None:
            rule, holds = _DIRECTIONS[self.gesture]
            if not holds(*self.direction):
                raise ValueError(f"direction: a {self.gesture} {rule}")
        return self


class MembraneSection(Section):
    """The pia-arachnoid, a thin stiff sheet on the surface that wrinkles under compression. Default: none."""

    probability: Share = 0.0
    """Share of sequences with the membrane; in the others it is stripped, as from many ex vivo specimens."""
    young_kpa: Range[Positive] = (100.0, 1000.0)
    """Its Young's modulus at small strain [kPa], drawn log-uniformly. Human: about 900 (3 times a shear
    modulus of 300: Vandemaele et al., Acta Biomater. 2025); less where it is slack or partly stripped. Beyond
    the toe region it is thousands (ovine 7,700: Fluids Barriers CNS 17, 2020)."""
    thickness_mm: Range[Positive] = (0.05, 0.2)
    """Its thickness [mm], drawn uniformly. Only thickness times modulus matters."""


class PulseSection(Section):
    """Pulsation: heart and breath move the exposed surface by a pressure from below. Default: none.

    Amplitudes are those of the centre of the opening, peak to peak, drawn uniformly; in a patient they are
    below 0.8 mm (Faria et al., Med. Phys. 41, 2014). Rates are drawn from those of adults at rest.
    """

    heart_mm: Range[NonNegative] = (0.0, 0.0)
    """Amplitude of the cardiac motion [mm]."""
    breath_mm: Range[NonNegative] = (0.0, 0.0)
    """Amplitude of the respiratory motion [mm]."""


Skulls = Annotated[
    tuple[Literal["bonded", "slip"], ...],
    Field(min_length=1),
    BeforeValidator(lambda value: (value,) if isinstance(value, str) else value),
]


def _of_tissue(young_kpa: tuple[float, float]) -> tuple[float, float]:
    for value in young_kpa:
        if not 0.01 <= value <= 300:
            unit, factor = ("Pa", 1e-3) if value > 1 else ("MPa", 1e3)
            raise ValueError(f"{value:g} kPa is not a soft tissue; was {unit} meant, {value * factor:g} kPa?")
    return young_kpa


class FemSection(Section):
    """The mechanics of the tissue and of the load."""

    law: Annotated[PlugInName, AfterValidator(LAWS.check_name)] = "auto"
    """Material law: linear, corotational, neo-hookean or that of an installed plug-in; auto selects the
    cheapest built-in one whose error relative to neo-Hookean at the largest load is within 5%."""
    tets: Annotated[int, Field(ge=100, le=200_000)] = 1600
    """Target number of quadratic tetrahedra; graded towards the craniotomy."""
    young_kpa: Annotated[Range[Positive], AfterValidator(_of_tissue)] = (0.5, 3.0)
    """Young's modulus E [kPa], drawn log-uniformly."""
    poisson: Range[Annotated[FiniteFloat, Field(ge=0, lt=0.5)]] = (0.4, 0.4)
    """Poisson's ratio, drawn uniformly. Brain within seconds of a load: 0.45 to nearly 0.5; drained: less."""
    skull: Skulls = ("bonded",)
    """Contact of tissue and skull around the opening, one or both, in equal shares: bonded, or slip, without
    friction (subarachnoid fluid)."""
    membrane: MembraneSection = MembraneSection()
    """The pia-arachnoid on the surface."""
    pulse: PulseSection = PulseSection()
    """Motion of the exposed surface by heart and breath."""
    load: Range[Positive] = (0.05, 0.4)
    """Peak load as P = F/(E a^2), dimensionless, so that one range suits every stiffness."""
    force_mn: Range[Positive] | None = None
    """Peak force of a contact [mN], instead of `load`."""
    footprint_mm: Range[Positive] = (3.0, 6.0)
    """Radius a of the contact [mm]."""
    gestures: Annotated[tuple[Kind, ...], Field(min_length=1)] = get_args(Kind)
    """Kinds of gesture that sequences are drawn from, in equal shares."""
    instruments: Range[Annotated[int, Field(ge=1, le=3)]] = (1, 1)
    """How many instruments act at once, each with a gesture, load, direction and timing of its own."""
    instrument_list: Annotated[tuple[InstrumentSection, ...], Field(max_length=3)] = ()
    """The first ones of `instruments`, of which there are at least as many, with given properties: a list of
    {gesture, place, direction, load, force_mn, footprint_mm, timing}; keys left out are drawn at random."""
    max_tilt_deg: Annotated[FiniteFloat, Field(ge=0, le=80)] = 65.0
    """The load's direction is drawn uniformly within this angle of the surface normal."""
    time: Literal["quasi-static", "dynamic"] = "quasi-static"
    """Equilibrium in every frame, or dynamics with inertia (backward Euler)."""
    mass_kg: Positive | None = None
    """Mass of the whole volume for `time: dynamic` [kg]. Empty: 1040 kg/m3."""
    relaxation: Annotated[
        tuple[tuple[Annotated[FiniteFloat, Field(gt=0, lt=1)], Positive], ...], Field(max_length=2)
    ] = ()
    """Prony terms [lost share of the stiffness, time in s], one or two: E is then the instantaneous
    modulus."""

    @model_validator(mode="after")
    def _some_stiffness_remains(self) -> FemSection:
        if sum(part for part, _ in self.relaxation) >= 1:
            raise ValueError("relaxation: the lost shares add up to the whole stiffness or more")
        return self

    @model_validator(mode="after")
    def _loads_are_in_the_laws_range(self, info: ValidationInfo) -> FemSection:
        for name, loads in () if info.context is STORED else self.load_ranges:
            check_load_range(self.chosen_law[0], loads, self.young_kpa[0], name)
        return self

    def load_range(self, instrument: InstrumentSection) -> LoadRange:
        """The ranges for an instrument: its own where it has some."""
        own = instrument if instrument.load or instrument.force_mn else self
        return LoadRange(own.load or self.load, own.force_mn, instrument.footprint_mm or self.footprint_mm)

    @property
    def load_ranges(self) -> list[tuple[str, LoadRange]]:
        """Ranges of instruments that are drawn freely, and of each in `instrument_list`, by label."""
        given = self.instrument_list
        drawn = [("", self.load_range(InstrumentSection()))] if self.instruments[1] > len(given) else []
        return drawn + [(f"instrument_list[{k}]: ", self.load_range(one)) for k, one in enumerate(given)]

    @property
    def chosen_law(self) -> tuple[str, str]:
        """The material law of every sequence, and the reason for it."""
        if self.law == "auto" and self.membrane.probability > 0:
            return "neo-hookean", "a membrane stretches as it bends, which the linear law leaves out"
        return choose_law(self.law, self.largest_load)

    @property
    def largest_load(self) -> float:
        """Largest P = F/(E a^2) that can be drawn."""
        return max(loads.largest(self.young_kpa[0]) for _, loads in self.load_ranges)
