"""The job's sections on mechanics: tissue, boundary conditions, instruments and their loads."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    FiniteFloat,
    Tag,
    ValidationInfo,
    field_serializer,
    model_validator,
)

from synth.fem.law_choice import LAWS, LoadRange, check_load_range, choose_law
from synth.job.types import (
    Direction,
    NonNegative,
    PlugInName,
    Positive,
    PronyTerms,
    Range,
    Section,
    Share,
    Vector,
)
from synth.plugins import STORED

Kind = Literal["pull", "push", "slide", "grasp", "retract", "tap"]
Instrument = Literal["forceps", "bayonet", "dissector", "suction", "spatula", "probe", "none"]


class OwnInstrument(Section):
    """An instrument of your own: a mesh whose tip rests on the middle of the contact."""

    file: Path
    """Its mesh (STL, OBJ, PLY), relative to the job file."""
    tip: Vector = (0.0, 0.0, 0.0)
    """Its tip, in the file's axes and unit."""
    axis: Direction = (0.0, 0.0, 1.0)
    """Direction from the tip to the hand, in the file's axes."""
    up: Direction | None = None
    """Direction that faces away from the tissue, in the file's axes. Empty: its z, or x if axis is z."""
    unit_mm: Positive = 1.0
    """Millimetres in the file's unit of length: 1000 for m."""


def is_mesh_name(value: object) -> bool:
    """Whether an instrument is named as a file, such as hook.stl, instead of as a kind."""
    return isinstance(value, str) and ("." in value or "/" in value)


def _as_mesh(value: Any) -> Any:
    return {"file": value} if is_mesh_name(value) else value


def _tag(value: Any) -> str:
    return "mesh" if isinstance(value, dict | OwnInstrument) else "kind"


Tool = Instrument | OwnInstrument
_MeshName = Annotated[str, Field(pattern=r"\.(stl|STL|obj|OBJ|ply|PLY)$")]
_AnyTool = Annotated[
    Annotated[Instrument, Tag("kind")] | Annotated[OwnInstrument, Tag("mesh")],
    Discriminator(_tag),
    BeforeValidator(_as_mesh, json_schema_input_type=Instrument | OwnInstrument | _MeshName),
]


def name_of(tool: Tool) -> str:
    """Name of an instrument, as sequences store it; of one's own that of its file."""
    return tool if isinstance(tool, str) else tool.file.name


INSTRUMENTS: dict[Kind, dict[Instrument, float]] = {
    "pull": {"forceps": 0.5, "bayonet": 0.5, "suction": 0.0},
    "grasp": {"forceps": 0.5, "bayonet": 0.5},
    "push": {"dissector": 0.6, "suction": 0.4, "spatula": 0.0, "probe": 0.0},
    "slide": {"dissector": 0.5, "suction": 0.5, "spatula": 0.0, "probe": 0.0},
    "tap": {"dissector": 0.7, "suction": 0.3, "probe": 0.0},
    "retract": {"spatula": 0.7, "dissector": 0.3, "suction": 0.0},
}
"""Instruments that each gesture takes, with their shares where a job names none; `none` suits every one."""

DRIVEN_SIZES_MM: dict[Instrument, tuple[tuple[float, float], tuple[float, float]]] = {
    "spatula": ((10.0, 30.0), (8.0, 15.0)),
    "dissector": ((5.0, 9.0), (3.0, 6.0)),
    "forceps": ((5.0, 8.0), (4.0, 8.0)),  # the fold between two tips of 2 to 4 mm each
    "bayonet": ((5.0, 8.0), (4.0, 8.0)),
    "suction": ((2.0, 4.0), (2.0, 4.0)),
    "probe": ((3.0, 6.0), (3.0, 6.0)),
    "none": ((6.0, 12.0), (6.0, 12.0)),
}
"""Lengths along and widths across an instrument of the tissue that a driven one holds; suction, probe and
none are round."""

CLEAR_MM = 1.0  # least distance of a contact from the rim

_Rule = tuple[str, Callable[[float, float, float], bool]]
_OUT: _Rule = "points out of the brain, z above 0", lambda x, y, z: z > 0
_IN: _Rule = "points into the brain, z below 0", lambda x, y, z: z < 0
_SIDE: _Rule = "points sideways, z not above 0 and x or y not 0", lambda x, y, z: z <= 0 and any((x, y))
_ALONG: _Rule = "needs x or y, the direction of its motion", lambda x, y, z: not x == y == 0
_DIRECTIONS = {"pull": _OUT, "grasp": _OUT, "push": _IN, "tap": _IN, "retract": _SIDE, "slide": _ALONG}
"""Rule for the direction of each gesture's load, and its test; z points out of the brain."""

_Time = FiniteFloat | Annotated[str, Field(max_length=40)]


def _read_times(timing: tuple[float | str, ...]) -> tuple[list[float], str]:
    """The numbers of times such as 0.2 or "0.2 s", and their unit, empty for parts of the sequence."""
    matches = [re.fullmatch(r"\s*(\d*\.?\d+(?:e-\d+)?)\s*(s|ms|)\s*", str(time)) for time in timing]
    parts = [match.groups() for match in matches if match]
    if len(parts) < len(timing) or len({unit for _, unit in parts}) > 1:
        raise ValueError("timing: give four parts of the sequence such as 0.2, or four times such as 0.2 s")
    return [float(number) for number, _ in parts], parts[0][1]


class InstrumentSection(Section):
    """One instrument with given properties; keys left out are drawn at random."""

    gesture: Kind | None = None
    """Kind of gesture. Empty: drawn from `fem.gestures`."""
    instrument: _AnyTool | None = None
    """The instrument, one that the gesture takes, or your own; none: not drawn. Empty: drawn as by
    `fem.instrument`."""
    place: tuple[FiniteFloat, FiniteFloat] | None = None
    """Centre of its contact at rest [mm]: x and y in world axes, from the centre of the opening."""
    direction: Direction | None = None
    """Direction of the load, in world axes with z out of the brain; normalised. For a slide, x and y are the
    direction of its motion. Needs `gesture`."""
    load: Range[Positive] | None = None
    """Peak load as P = F/(E a^2)."""
    force_mn: Range[Positive] | None = None
    """Peak force of a contact [mN], instead of `load`; of a driven instrument, of all its contacts."""
    travel_mm: Range[Positive] | None = None
    """Way of the tips of a driven instrument to its peak [mm], instead of `force_mn`."""
    footprint_mm: Range[Positive] | None = None
    """Radius a of its contact [mm]; of a driven one, that of a circle of its area."""
    timing: tuple[_Time, _Time, _Time, _Time] | None = None
    """Touch, full load, beginning of the unloading, release: rising fractions of the sequence, or times such
    as 0.2 s or 200 ms from its first frame. For a tap only the first and the last are used."""

    @model_validator(mode="after")
    def _goes_together(self) -> InstrumentSection:
        if self.load is not None and self.force_mn is not None:
            raise ValueError("either load or force_mn, not both")
        if self.travel_mm is not None and (self.load is not None or self.force_mn is not None):
            raise ValueError("travel_mm: either the way or the force, not both")
        if self.timing is not None:
            touch, full, fall, release = _read_times(self.timing)[0]
            if not 0 < touch < full <= fall < release:
                raise ValueError("timing: touch, full load, fall and release must follow one another")
        if self.direction is not None:
            if self.gesture is None:
                raise ValueError("direction needs gesture: that of a push points inwards, of a pull outwards")
            rule, is_allowed = _DIRECTIONS[self.gesture]
            if not is_allowed(*self.direction):
                raise ValueError(f"direction: a {self.gesture} {rule}")
        return self

    def scale_timing(self, frames: int, fps: float) -> InstrumentSection:
        """The same with times as parts of a sequence. ValueError, in the unit given, if it ends too late."""
        if self.timing is None:
            return self
        numbers, unit = _read_times(self.timing)
        end = (frames - 1) / fps * {"s": 1.0, "ms": 1000.0}[unit] if unit else 1.0
        if numbers[3] >= end:
            if not unit:
                what = "is not below 1, the sequence's end; for seconds add s"
                raise ValueError(f"timing: {numbers[3]:g} {what}")
            ends = f"{numbers[3]:g} {unit}, the sequence at {end:.4g} {unit}"
            raise ValueError(f"timing ends at {ends}: release earlier, or raise frames")
        return self.model_copy(update={"timing": tuple(number / end for number in numbers)})


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
    stiffening: Range[NonNegative] = (0.0, 0.0)
    """Exponent b of its energy, drawn uniformly: a strip's tension grows by exp(b (l^2 + 2/l - 3)) at a
    stretch l. 30: five times as stiff at a strain of 0.1 as at rest; 0: neo-Hookean."""


class PulseSection(Section):
    """Pulsation: heart and breath move the exposed surface by a pressure from below. Default: none.

    Amplitudes are those of the centre of the opening, peak to peak, drawn uniformly; in a patient they are
    below 0.8 mm (Faria et al., Med. Phys. 41, 2014). Rates are drawn from those of adults at rest.
    """

    heart_mm: Range[NonNegative] = (0.0, 0.0)
    """Amplitude of the cardiac motion [mm]."""
    breath_mm: Range[NonNegative] = (0.0, 0.0)
    """Amplitude of the respiratory motion [mm]."""


_SINGLE = (str, dict, OwnInstrument)
_OneOrMore = BeforeValidator(lambda value: (value,) if isinstance(value, _SINGLE) else value)
Contact = Literal["loaded", "driven"]
Contacts = Annotated[tuple[Contact, ...], Field(min_length=1), _OneOrMore]
Skulls = Annotated[tuple[Literal["bonded", "slip"], ...], Field(min_length=1), _OneOrMore]


def _check_young(young_kpa: tuple[float, float]) -> tuple[float, float]:
    for value in young_kpa:
        if not 0.01 <= value <= 300:
            unit, factor = ("Pa", 1e-3) if value > 1 else ("MPa", 1e3)
            raise ValueError(f"{value:g} kPa is not a soft tissue; was {unit} meant, {value * factor:g} kPa?")
    return young_kpa


def _check_alpha(alpha: tuple[float, float]) -> tuple[float, float]:
    if not -40 <= alpha[0] <= alpha[1] <= 40 or alpha[0] <= 0 <= alpha[1]:
        raise ValueError("both ends must be below 0, at least -40, or both above 0, at most 40")
    return alpha


class FemSection(Section):
    """The mechanics of the tissue and of the load."""

    law: Annotated[PlugInName, AfterValidator(LAWS.check_name)] = "auto"
    """Material law: linear, corotational, neo-hookean, ogden, which stiffens, or that of an installed
    plug-in; auto selects the cheapest built-in one whose error relative to neo-Hookean at the largest load is
    within 5%, and ogden for driven contacts."""
    alpha: Annotated[Range[FiniteFloat], AfterValidator(_check_alpha)] = (-4.7, -4.7)
    """Exponent of law ogden, drawn uniformly. Swine: -4.7 (Miller & Chinzei, J. Biomech. 35, 2002); human
    about -20 (Budday et al., Acta Biomater. 48, 2017; Bennion et al., J. R. Soc. Interface, 2022)."""
    tets: Annotated[int, Field(ge=100, le=200_000)] = 1600
    """Target number of quadratic tetrahedra; graded towards the craniotomy."""
    young_kpa: Annotated[Range[Positive], AfterValidator(_check_young)] = (0.5, 3.0)
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
    """Peak force of a contact [mN], instead of `load`; of a driven instrument, of all its contacts."""
    contact: Contacts = ("loaded",)
    """Contact of instruments and tissue, one or both, in equal shares of the sequences. Loaded: a pressure
    that is given, in the range of small strain. Driven: the instrument holds the tissue under it and moves
    it; the force is the reaction. For large loads; sizes are then those of instruments, without slides."""
    travel_mm: Range[Positive] | None = None
    """Way of the tips of a driven instrument to its peak [mm], drawn uniformly, at most that over which a
    contact of its size holds; it ends earlier where tissue bears no more. Either this or `force_mn`."""
    travel_scale: Literal["even", "log"] = "even"
    """Whether `travel_mm` is drawn evenly or evenly in its logarithm, as many small motions as large ones."""
    footprint_mm: Range[Positive] = (3.0, 6.0)
    """Radius a of a loaded contact [mm]."""
    gestures: Annotated[tuple[Kind, ...], Field(min_length=1)] = get_args(Kind)
    """Kinds of gesture that sequences are drawn from, in equal shares. Not given: those that the named
    instruments suit."""
    instrument: Annotated[tuple[_AnyTool, ...], _OneOrMore] = ()
    """Instruments, one or more: each gesture is made with one that it takes, in equal shares; one named twice
    has two. None: it is not drawn. Your own: a mesh such as hook.stl, or {file, tip, axis, up, unit_mm} (see
    docs/howto/instruments.md), which suits all but grasps. Empty: those usual for each gesture."""
    instruments: Range[Annotated[int, Field(ge=1, le=3)]] = (1, 1)
    """How many instruments act at once, each with a gesture, load, direction and timing of its own."""
    instrument_list: Annotated[tuple[InstrumentSection, ...], Field(max_length=3)] = ()
    """The first ones of `instruments`, of which there are at least as many, with given properties: a list of
    {gesture, instrument, place, direction, load, force_mn, footprint_mm, timing}; keys left out are drawn at
    random."""
    max_tilt_deg: Annotated[FiniteFloat, Field(ge=0, le=80)] = 65.0
    """The load's direction is drawn uniformly within this angle of the surface normal."""
    time: Literal["quasi-static", "dynamic"] = "quasi-static"
    """Equilibrium in every frame, or dynamics with inertia (backward Euler)."""
    mass_kg: Positive | None = None
    """Mass of the whole volume for `time: dynamic` [kg]. Empty: 1040 kg/m3."""
    relaxation: PronyTerms = ()
    """Prony terms [lost share of the stiffness, time in s], one or two: E is then the instantaneous
    modulus."""

    @field_serializer("contact")
    def _dump_contact(self, contact: tuple[Contact, ...]) -> str | list[str]:
        """A single kind as before there were two, so that older jobs keep their identity."""
        return contact[0] if len(contact) == 1 else list(contact)

    @model_validator(mode="after")
    def _contacts_are_loaded_or_driven(self) -> FemSection:
        labelled = [(f"instrument_list[{k}].", section) for k, section in enumerate(self.instrument_list)]
        if "driven" not in self.contact:
            travels = [("", self.travel_mm), *((label, section.travel_mm) for label, section in labelled)]
            for label, travel_mm in travels:
                if travel_mm is not None:
                    raise ValueError(f"{label}travel_mm needs contact: driven")
            return self
        if self.time == "dynamic":
            raise ValueError("contact: driven needs time: quasi-static")
        slides = "gestures" in self.model_fields_set and "slide" in self.gestures
        has_both = "loaded" in self.contact
        if slides and (not has_both or {*self.gestures} == {"slide"}):
            raise ValueError("gestures: a driven contact holds the tissue and doesn't slide; remove slide")
        for label, section in labelled:
            if section.gesture == "slide":
                raise ValueError(f"{label}gesture: a driven contact holds the tissue and doesn't slide")
        if has_both:
            if self.travel_mm is None:
                raise ValueError("travel_mm: driven contacts next to loaded ones need it")
            return self
        if self.travel_mm is not None and self.force_mn is not None:
            raise ValueError("travel_mm: either the way or force_mn, not both")
        general = self.travel_mm or self.force_mn
        if self.instruments[1] > len(labelled) and general is None:
            raise ValueError("travel_mm: a driven contact needs travel_mm or force_mn")
        for label, section in labelled:
            if not (section.travel_mm or section.force_mn or general) or section.load is not None:
                raise ValueError(f"{label}travel_mm: a driven contact needs travel_mm or force_mn")
        return self

    @model_validator(mode="after")
    def _law_bears_loads(self, info: ValidationInfo) -> FemSection:
        is_checked = info.context is not STORED and "loaded" in self.contact
        for name, loads in self.load_ranges if is_checked else ():
            check_load_range(self.of_contact("loaded").chosen_law[0], loads, self.young_kpa[0], name)
        return self

    @model_validator(mode="after")
    def _gestures_take_their_instruments(self) -> FemSection:
        if "gestures" not in self.model_fields_set:
            object.__setattr__(self, "gestures", tuple(self.choices()))
        misfits = [("instrument", kind) for kind in self.gestures if kind not in self.choices()]
        for k, line in enumerate(self.instrument_list):
            kinds = self.gestures if line.gesture is None else (line.gesture,)
            key = "instrument" if line.instrument is None else f"instrument_list[{k}].instrument"
            misfits += [] if self.choices(line) else [(key, kind) for kind in kinds]
        if misfits:
            messages = [f"{key}: a {kind} takes {' or '.join(INSTRUMENTS[kind])}" for key, kind in misfits]
            raise ValueError("; ".join(dict.fromkeys(messages)))
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the instruments in `instrument`."""
        return tuple(map(name_of, self.instrument))

    @property
    def own_instruments(self) -> dict[str, OwnInstrument]:
        """The instruments that are meshes of one's own, by name. ValueError: two share one."""
        meshes: dict[str, OwnInstrument] = {}
        for tool in (*self.instrument, *(line.instrument for line in self.instrument_list)):
            if isinstance(tool, OwnInstrument) and meshes.setdefault(name_of(tool), tool) != tool:
                raise ValueError(f"instrument: two are called {name_of(tool)}; rename one's file")
        return meshes

    def choices(self, line: InstrumentSection = InstrumentSection()) -> dict[Kind, dict[Tool, float]]:
        """Gestures that an instrument may be drawn with, each with its instruments and their shares."""
        tools = self.instrument if line.instrument is None else (line.instrument,)
        shares_of: dict[Kind, dict[Tool, float]] = {}
        for kind in self.gestures if line.gesture is None else (line.gesture,):
            shares: dict[Tool, float] = {name: share for name, share in INSTRUMENTS[kind].items()}
            if tools:
                suitable = {*shares, "none", *(() if kind == "grasp" else self.own_instruments.values())}
                shares = {name: float(tools.count(name)) for name in tools if name in suitable}
            total = sum(shares.values())
            shares_of[kind] = {name: share / total for name, share in shares.items() if share}
        if "loaded" not in self.contact:
            shares_of.pop("slide", None)
        return {kind: shares for kind, shares in shares_of.items() if shares}

    def load_range(self, instrument: InstrumentSection) -> LoadRange:
        """The ranges for an instrument: its own where it has some."""
        source = instrument if instrument.load or instrument.force_mn else self
        return LoadRange(
            source.load or self.load, source.force_mn, instrument.footprint_mm or self.footprint_mm
        )

    @property
    def load_ranges(self) -> list[tuple[str, LoadRange]]:
        """Ranges of instruments that are drawn freely, and of each in `instrument_list`, by label."""
        lines = self.instrument_list
        ranges = [("", self.load_range(InstrumentSection()))] if self.instruments[1] > len(lines) else []
        return ranges + [(f"instrument_list[{k}]: ", self.load_range(line)) for k, line in enumerate(lines)]

    def of_contact(self, contact: Contact) -> FemSection:
        """The section of the sequences with one kind of contact.

        Of both kinds, forces and loads are of loaded contacts and ways of driven ones, also in
        `instrument_list`.
        """
        changes: dict[str, Any] = {"contact": (contact,)}
        if len({*self.contact}) > 1:
            left_out = ("travel_mm",) if contact == "loaded" else ("force_mn", "load")
            cleared = {key: None for key in left_out}
            lines = tuple(instrument.model_copy(update=cleared) for instrument in self.instrument_list)
            changes |= {"instrument_list": lines}
            if contact == "driven":
                changes |= {"force_mn": None}
        return self.model_copy(update=changes)

    @property
    def chosen_law(self) -> tuple[str, str]:
        """The material law of every sequence with the first kind of contact, and the reason for it."""
        if self.law == "auto" and self.contact[0] == "driven":
            return "ogden", "driven contacts strain tissue beyond the range of the other laws"
        if self.law == "auto" and self.membrane.probability > 0:
            return "neo-hookean", "a membrane stretches as it bends, which the linear law leaves out"
        return choose_law(self.law, self.largest_load)

    @property
    def largest_load(self) -> float:
        """Largest P = F/(E a^2) that can be drawn."""
        return max(loads.largest(self.young_kpa[0]) for _, loads in self.load_ranges)
