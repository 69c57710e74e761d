"""The job: everything one dataset depends on, as one validated object (`synth.job.reader` reads it)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, FiniteFloat, model_validator

from synth import fields
from synth.job.instrument import CLEAR_MM, Kind
from synth.job.instrument import InstrumentSection as InstrumentSection
from synth.job.laws import LAWS, choose_law, largest_load
from synth.job.microscope import LightSection as LightSection
from synth.job.microscope import RenderSection as RenderSection
from synth.job.microscope import SensorSection as SensorSection
from synth.job.types import (
    InstrumentRange,
    NonNegativeRange,
    PlugInName,
    PoissonRange,
    Positive,
    PositiveRange,
    Section,
    Share,
    ShareRange,
    Vector,
)
from synth.plugins import ESTIMATORS


class PlaceSection(Section):
    """A place on the brain's surface."""

    point: Vector
    """A point on (or near) the surface, in the mesh's own axes [mm]."""
    direction: Vector
    """Outward direction there, in the mesh's own axes; normalised."""

    @model_validator(mode="after")
    def _direction_has_length(self) -> PlaceSection:
        if not any(self.direction):
            raise ValueError("direction has no length")
        return self


class CraniotomySection(Section):
    """Where the skull is open."""

    point: Vector | None = None
    """A point on (or near) the brain surface, in the mesh's own axes [mm]. Needed with `anatomy.mesh`."""
    direction: Vector | None = None
    """Outward direction of the opening, in the mesh's own axes; normalised. Needed with `anatomy.mesh`."""
    radius_mm: Positive = 12.0
    """Radius of the opening [mm]."""
    also: Annotated[tuple[PlaceSection, ...], Field(max_length=100)] = ()
    """Further places on the same mesh, each with point and direction: anatomies take them in turn, the first
    being `point`. `learn train` can then tell openings apart, though not brains."""

    @model_validator(mode="after")
    def _direction_has_length(self) -> CraniotomySection:
        if self.direction is not None and not any(self.direction):
            raise ValueError("direction has no length")
        return self


class AttachmentSection(Section):
    """A region in which tissue is held: falx, tentorium, an adhesion. The skull holds it in any case."""

    point: Vector
    """Its middle [mm], in the mesh's own axes; for the block, from the opening's centre with z outwards."""
    radius_mm: Positive
    """How far it reaches from its middle [mm]."""
    normal: Vector | None = None
    """Of a sheet (falx, tentorium) through the middle, in the same axes. Empty: a ball."""
    thickness_mm: Positive = 3.0
    """Thickness of a sheet [mm]."""
    firm_per_mm: Positive = 2.0
    """Traction per displacement as a multiple of E, per mm; the skull's is 2."""

    @model_validator(mode="after")
    def _normal_has_length(self) -> AttachmentSection:
        if self.normal is not None and not any(self.normal):
            raise ValueError("normal has no length")
        return self


class AnatomySection(Section):
    """The brain: a procedural block, or a user's surface."""

    mesh: Path | None = None
    """Surface of a brain (OBJ, STL, PLY or VTK, mm); relative to the job file. Empty: a procedural block."""
    variety: Annotated[int, Field(ge=1)] | None = None
    """Number of distinct anatomies in the dataset. Empty: every sequence has its own."""
    dome_mm: Positive = 70.0
    """Procedural block: radius of curvature of the brain surface [mm]."""
    gyrus_mm: PositiveRange = (10.0, 15.0)
    """Procedural relief: spacing of the gyri [mm]."""
    sulcus_mm: NonNegativeRange = (0.6, 1.4)
    """Procedural relief: depth of the sulci as seen from outside [mm]."""
    vertices: Annotated[int, Field(ge=400, le=400_000)] = 40_000
    """Vertices of the fine surface that is loaded, moved and rendered."""
    craniotomy: CraniotomySection = CraniotomySection()
    """Where the skull is open."""
    attachments: tuple[AttachmentSection, ...] = ()
    """Regions in which the tissue is held inside, such as the falx: a list of {point, radius_mm, normal,
    thickness_mm, firm_per_mm}, normal for a sheet. Empty: the skull alone holds it."""

    @model_validator(mode="after")
    def _mesh_is_placed(self) -> AnatomySection:
        if self.mesh is not None and (self.craniotomy.point is None or self.craniotomy.direction is None):
            raise ValueError("a mesh needs craniotomy.point and craniotomy.direction")
        if self.mesh is None and self.craniotomy.also:
            raise ValueError("craniotomy.also is for a mesh; a procedural block is opened in its middle")
        return self

    def opened(self, number: int) -> AnatomySection:
        """The section with the place that anatomy `number` is opened at as its only one."""
        where = self.craniotomy
        if not where.also:
            return self
        turn = number % (len(where.also) + 1)
        place = where if turn == 0 else where.also[turn - 1]
        moved = {"point": place.point, "direction": place.direction, "also": ()}
        return self.model_copy(update={"craniotomy": where.model_copy(update=moved)})


Family = Literal["healthy", "hyperaemic", "pale", "oedematous", "calf"]


class AppearanceSection(Section):
    """How the surface looks."""

    families: tuple[Family, ...] = ("healthy",)
    """Appearance families that sequences are drawn from, in equal shares."""
    photo: Path | None = None
    """A photograph used as albedo, relative to the job file. Empty: procedural vessels and parenchyma."""
    cottonoid: Share = 0.2
    """Share of sequences with a cotton patty on the rim."""
    blood: ShareRange | None = None
    """Blood on the rim, from none (0) to soaked (1). Empty: as the family has it."""


Skulls = Annotated[
    tuple[Literal["bonded", "slip"], ...],
    Field(min_length=1),
    BeforeValidator(lambda value: (value,) if isinstance(value, str) else value),
]


class MembraneSection(Section):
    """The pia-arachnoid, a thin stiff sheet on the surface that wrinkles under compression. Default: none."""

    intact: Share = 0.0
    """Part of the sequences that have it; from the others it is stripped, as from many ex vivo specimens."""
    young_kpa: PositiveRange = (100.0, 1000.0)
    """Its Young's modulus at small strain [kPa], drawn log-uniformly. Human: about 900 (3 times a shear
    modulus of 300: Vandemaele et al., Acta Biomater. 2025); less where it is slack or partly stripped. Past
    the toe of the curve it is thousands (ovine 7,700: Fluids Barriers CNS 17, 2020)."""
    thickness_mm: PositiveRange = (0.05, 0.2)
    """Its thickness [mm], drawn uniformly. What counts is thickness times modulus."""


class PulseSection(Section):
    """Heart and breath: the exposed surface rises and falls, by a pressure from below. Default: it is still.

    Amplitudes are of the middle of the opening, peak to peak, drawn uniformly as the rates are. In a patient
    below 0.8 mm, with peaks at 0.2 and 1 Hz (Faria et al., Med. Phys. 41, 2014).
    """

    heart_mm: NonNegativeRange = (0.0, 0.0)
    """Motion with the heart [mm]."""
    heart_hz: PositiveRange = (1.0, 1.7)
    """Heart beats a second."""
    breath_mm: NonNegativeRange = (0.0, 0.0)
    """Motion with the breath [mm]."""
    breath_hz: PositiveRange = (0.2, 0.35)
    """Breaths a second."""


@dataclass(frozen=True)
class Demand:
    """How hard an instrument may load tissue: the ranges that count for it."""

    load: tuple[float, float]
    """P = F/(E a^2), where no force is given."""
    force_mn: tuple[float, float] | None
    footprint_mm: tuple[float, float]


class FemSection(Section):
    """The physics of the tissue and of the load."""

    law: Annotated[PlugInName, AfterValidator(lambda name: LAWS.check_name(name, "auto"))] = "auto"
    """Material law: linear, corotational, neo-hookean or an installed plug-in's; auto takes the
    cheapest of ours whose error against neo-Hookean at the largest load is within 5%."""
    tets: Annotated[int, Field(ge=100, le=200_000)] = 1600
    """Number of quadratic tetrahedra to aim for; graded towards the craniotomy."""
    young_kpa: PositiveRange = (0.5, 3.0)
    """Young's modulus E [kPa], drawn log-uniformly."""
    poisson: PoissonRange = (0.4, 0.4)
    """Poisson's ratio, drawn uniformly. Brain within seconds: 0.45 to nearly 0.5; drained: less."""
    skull: Skulls = ("bonded",)
    """How tissue is held round the opening, one or both, in equal shares: bonded to the skull, or free to
    slip along it (subarachnoid fluid)."""
    membrane: MembraneSection = MembraneSection()
    """The pia-arachnoid on the surface."""
    pulse: PulseSection = PulseSection()
    """Motion of the exposed surface that no tool makes."""
    load: PositiveRange = (0.05, 0.4)
    """Peak load as P = F/(E a^2), dimensionless, so that one range suits every stiffness."""
    force_mn: PositiveRange | None = None
    """Peak force of a contact [mN]; given, it takes the place of `load`."""
    footprint_mm: PositiveRange = (3.0, 6.0)
    """Radius a of the contact [mm]."""
    gestures: Annotated[tuple[Kind, ...], Field(min_length=1)] = (
        "pull",
        "push",
        "slide",
        "grasp",
        "retract",
        "tap",
    )
    """Kinds of gesture that sequences are drawn from, in equal shares."""
    instruments: InstrumentRange = (1, 1)
    """How many instruments act at once, each with a gesture, load, direction and timing of its own."""
    crew: Annotated[tuple[InstrumentSection, ...], Field(max_length=3)] = ()
    """Instruments as asked, the first ones of `instruments` (there are at least so many): a list of {gesture,
    place, direction, load, force_mn, footprint_mm, timing}, each of them drawn where it is left out."""
    within_mm: Positive | None = None
    """What is loaded keeps within this radius of the opening's middle [mm], such as what the camera sees of a
    wide opening; a `crew`'s places count as they are. Empty: anywhere in the opening."""
    cone_deg: Annotated[FiniteFloat, Field(ge=0, le=80)] = 65.0
    """The load's direction is drawn uniformly within this angle of the surface normal."""
    time: Literal["quasi-static", "dynamic"] = "quasi-static"
    """Equilibrium in every frame, or motion with inertia (backward Euler)."""
    mass_kg: Positive | None = None
    """Dynamic: mass of the whole volume [kg]. Empty: 1040 kg/m3."""
    relaxation: Annotated[
        tuple[tuple[Annotated[FiniteFloat, Field(gt=0, lt=1)], Positive], ...], Field(max_length=2)
    ] = ()
    """Prony terms [part of the stiffness lost, time in s], one or two: E is then that of a sudden load."""

    @model_validator(mode="after")
    def _some_stiffness_stays(self) -> FemSection:
        if sum(part for part, _ in self.relaxation) >= 1:
            raise ValueError("relaxation: the parts lost add up to the whole stiffness or more")
        return self

    @model_validator(mode="after")
    def _load_is_in_the_laws_range(self) -> FemSection:
        law, _ = self.chosen_law
        largest = largest_load(law)
        for where, one in self._demands:
            said = self._past_range(one, law, largest)
            if said:
                raise ValueError(where + said)
        return self

    def _past_range(self, one: Demand, law: str, largest: float) -> str:
        """What is wrong with a demand, if it is past what the law holds for."""
        load = self._largest(one)
        if one.force_mn is None and load > largest:
            return f"load {load:g} is past the range of the {law} law; the largest valid value is {largest:g}"
        if one.force_mn is not None and load > largest * (1 + 1e-9):
            young, radius = self.young_kpa[0], one.footprint_mm[0]
            return (
                f"force_mn {one.force_mn[1]:g} on the softest tissue ({young:g} kPa) under the smallest "
                f"contact ({radius:g} mm) is a load of {load:.3g}, past the range of the {law} law; "
                f"the largest valid value is {largest * young * radius**2:.4g}"
            )
        return ""

    def demand(self, asked: InstrumentSection) -> Demand:
        """The ranges that count for an instrument: its own where it says so."""
        footprint = asked.footprint_mm or self.footprint_mm
        if asked.load or asked.force_mn:
            return Demand(asked.load or self.load, asked.force_mn, footprint)
        return Demand(self.load, self.force_mn, footprint)

    @property
    def _demands(self) -> list[tuple[str, Demand]]:
        """What can be drawn: of each instrument that is asked for, and of those that aren't."""
        drawn = [("", self.demand(InstrumentSection()))] if self.instruments[1] > len(self.crew) else []
        return drawn + [(f"crew[{k}]: ", self.demand(one)) for k, one in enumerate(self.crew)]

    def _largest(self, one: Demand) -> float:
        if one.force_mn is None:
            return one.load[1]
        return one.force_mn[1] / (self.young_kpa[0] * one.footprint_mm[0] ** 2)

    @property
    def chosen_law(self) -> tuple[str, str]:
        """The material law of every sequence, and why."""
        if self.law == "auto" and self.membrane.intact > 0:
            return "neo-hookean", "a membrane stretches as it bends, which the linear law leaves out"
        return choose_law(self.law, self.largest_load)

    @property
    def largest_load(self) -> float:
        """Largest P = F/(E a^2) that can be drawn."""
        return max(self._largest(one) for _, one in self._demands)


class FlowSection(Section):
    """Recovering displacement from the video."""

    backend: Annotated[PlugInName, AfterValidator(lambda name: ESTIMATORS.check_name(name, "ideal"))] = "tvl1"
    """Estimator: tvl1, opencv-tvl1, dis or an installed plug-in's; `ideal` computes no recovered flow."""
    warps: Annotated[int, Field(ge=1, le=12)] = 3
    """tvl1: linearisations a level of a frame that starts from the one before; twice as many from nothing."""


def _known(names: tuple[str, ...], known: tuple[str, ...]) -> tuple[str, ...]:
    strangers = [name for name in names if name not in known]
    if strangers:
        raise ValueError(
            f"{', '.join(strangers)}: not among {', '.join(known) or 'any (there are none yet)'}"
        )
    return names


class StoreSection(Section):
    """What is kept of every sequence. `synth schema --fields` lists the fields and what they take."""

    extra: Annotated[tuple[str, ...], AfterValidator(lambda names: _known(names, fields.EXTRA))] = ()
    """Fields to keep besides the usual ones."""
    without: Annotated[tuple[str, ...], AfterValidator(lambda names: _known(names, fields.SPARED))] = ()
    """Fields to leave out, of those that can be spared: depth, flow_confidence, and of a second lens
    flow_right, visible_right, depth_right."""
    flow: Literal["float32", "float16"] = "float32"
    """Type of both flows stored; float16 rounds motion below 16 px by at most 0.004 px, below 32 by 0.008."""


class CardSection(Section):
    """What a person says of the dataset, for its card. Changes no sequence."""

    title: str = "Synthetic neurosurgical sequences with ground-truth force"
    """Name of the dataset."""
    summary: str | None = None
    """What it was made for, in your words."""
    licence: str | None = None
    """Licence under which you share it, as an SPDX name (cc-by-4.0). Empty: none is given."""
    authors: tuple[str, ...] = ()
    """Who made it."""
    contact: str | None = None
    """Where questions go."""
    url: str | None = None
    """Where the dataset is to be found."""
    published: Annotated[str, Field(pattern=r"^\d{4}-\d{2}-\d{2}$")] | None = None
    """Date of publication, in quotes: "2027-01-31"."""


class Job(Section):
    """One dataset."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Root of every random draw. Same job, same bytes."""
    sequences: Annotated[int, Field(ge=1, le=1_000_000)] = 24
    """Number of sequences."""
    frames: Annotated[int, Field(ge=2, le=10_000)] = 24
    """Frames a sequence; frame 0 is the rest frame."""
    fps: Positive = 25.0
    """Frames a second of the recorded video."""
    anatomy: AnatomySection = AnatomySection()
    appearance: AppearanceSection = AppearanceSection()
    light: LightSection = LightSection()
    sensor: SensorSection = SensorSection()
    fem: FemSection = FemSection()
    render: RenderSection = RenderSection()
    flow: FlowSection = FlowSection()
    store: StoreSection = StoreSection()
    labels: Literal["published", "none"] = "none"
    """Noise on the labels of the field `intensity`: the published method's first stage, or none, as its code
    ships. Its second stage is in `intensity` and `flow_noisy` either way; see `store.extra`."""
    card: CardSection = CardSection()

    @model_validator(mode="after")
    def _second_lens_exists(self) -> Job:
        asked = [name for name in self.store.extra if name.endswith("_right")]
        if asked and self.render.stereo_mm == 0:
            raise ValueError(f"store.extra: {asked[0]} needs a second lens; set render.stereo_mm")
        return self

    @model_validator(mode="after")
    def _crew_is_in_the_opening(self) -> Job:
        radius = self.anatomy.craniotomy.radius_mm
        for k, one in enumerate(self.fem.crew):
            least = self.fem.demand(one).footprint_mm[0]
            if one.place is not None and math.hypot(*one.place) + least + CLEAR_MM > radius:
                raise ValueError(
                    f"fem.crew[{k}].place: {math.hypot(*one.place):.3g} mm from the middle, a contact of "
                    f"{least:g} mm radius reaches under the rim of an opening of {radius:g} mm radius"
                )
        return self

    @property
    def kept_fields(self) -> tuple[str, ...]:
        """Names of the fields that its sequences hold."""
        recovered = self.flow.backend != "ideal"
        stereo = self.render.stereo_mm > 0
        motion = stereo and recovered
        return fields.kept(
            self.store.extra, self.store.without, recovered=recovered, stereo=stereo, motion=motion
        )
