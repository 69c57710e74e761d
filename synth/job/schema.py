"""The job: all settings of one dataset, as one validated object (`synth.job.reader` reads it)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, FiniteFloat, ValidationInfo, model_validator

from synth.errors import did_you_mean
from synth.fields import EXTRA, FIELDS, SPARED
from synth.job.mechanics_sections import CLEAR_MM
from synth.job.mechanics_sections import FemSection as FemSection
from synth.job.mechanics_sections import MembraneSection as MembraneSection
from synth.job.mechanics_sections import PulseSection as PulseSection
from synth.job.microscope import LightSection as LightSection
from synth.job.microscope import RenderSection as RenderSection
from synth.job.microscope import SensorSection as SensorSection
from synth.job.types import (
    Direction,
    Groups,
    NonNegative,
    PlugInName,
    Positive,
    Range,
    Section,
    Share,
    Vector,
)
from synth.plugins import ESTIMATORS, STORED


class PlaceSection(Section):
    """A place on the brain's surface."""

    point: Vector
    """A point on (or near) the surface, in the mesh's own axes [mm]."""
    direction: Direction
    """Outward direction there, in the mesh's own axes; normalised."""


class CraniotomySection(Section):
    """Where the skull is open."""

    point: Vector | None = None
    """A point on the brain surface, in the mesh's own axes [mm]: RAS, as 3D Slicer shows, if the file
    states its space (SPACE=LPS). Needed with `anatomy.mesh`."""
    direction: Direction | None = None
    """Outward direction of the opening, in the mesh's own axes; normalised. Needed with `anatomy.mesh`."""
    radius_mm: Positive = 12.0
    """Radius of the opening [mm]."""
    also: Annotated[tuple[PlaceSection, ...], Field(max_length=100)] = ()
    """Further places on the same mesh, each with point and direction: sequences use them in turn, beginning
    with `point`. `synth split --by opening` separates these places, although the brain is the same."""


class AttachmentSection(Section):
    """A region in which tissue is fixed: falx, tentorium, an adhesion. The skull holds it in any case."""

    point: Vector
    """Its centre [mm], in the mesh's own axes; for the block, from the opening's centre with z outwards."""
    radius_mm: Positive
    """Its radius [mm]."""
    normal: Direction | None = None
    """Normal of a sheet (falx, tentorium) through the centre, in the same axes. Empty: a ball."""
    thickness_mm: Positive = 3.0
    """Thickness of a sheet [mm]."""


class AnatomySection(Section):
    """The brain: a procedural block, or a user's surface."""

    mesh: Path | None = None
    """Brain (OBJ, STL, PLY, OFF, VTK, VTP, GIfTI, lh.pial; mm), relative to the job file. Empty: a block."""
    fill_holes: bool = False
    """Whether holes of the mesh are closed, each by a fan of triangles; an error if that is not possible."""
    dome_mm: Positive = 70.0
    """Procedural block: radius of curvature of the brain surface [mm]."""
    gyrus_mm: Range[Annotated[FiniteFloat, Field(ge=1, le=100)]] = (10.0, 15.0)
    """Procedural relief: spacing of the gyri [mm], 1-100."""
    sulcus_mm: Range[NonNegative] = (1.6, 2.8)
    """Procedural relief: visible depth of the sulci below the crests of the gyri [mm]."""
    vertices: Annotated[int, Field(ge=400, le=400_000)] = 40_000
    """Vertices of the fine surface that is loaded, moved and rendered. Not given: one per four pixels of the
    picture, at least 6000 and at most 40,000."""
    craniotomy: CraniotomySection = CraniotomySection()
    """Where the skull is open."""
    attachments: tuple[AttachmentSection, ...] = ()
    """Regions inside in which the tissue is fixed, such as the falx: a list of {point, radius_mm, normal,
    thickness_mm}, normal for a sheet. Empty: the skull holds it, and a block its walls and base."""

    @model_validator(mode="after")
    def _mesh_is_placed(self) -> AnatomySection:
        if self.mesh is not None and (self.craniotomy.point is None or self.craniotomy.direction is None):
            raise ValueError("a mesh needs craniotomy.point and craniotomy.direction")
        if self.mesh is None and self.craniotomy.also:
            raise ValueError("craniotomy.also needs a mesh; a procedural block is opened in its centre")
        return self

    def select_opening(self, index: int) -> AnatomySection:
        """The section with only the craniotomy of sequence `index`."""
        craniotomy = self.craniotomy
        places: tuple[CraniotomySection | PlaceSection, ...] = (craniotomy, *craniotomy.also)
        place = places[index % len(places)]
        changes = {"point": place.point, "direction": place.direction, "also": ()}
        return self.model_copy(update={"craniotomy": craniotomy.model_copy(update=changes)})


class MechanicsSection(Section):
    """Motion and load of another program's files, instead of our finite elements'."""

    source: Path | None = None
    """Files of a deforming surface or volume: numbered .vtu, .vtk, .vtp, .obj, .ply or .glb as a pattern with
    *, a collection of them (.pvd, .series), a run of the published recorder, an .npz, or a folder with one of
    these; relative to the job file. A pattern that ends in */ names folders, used by sequences in turn. Its
    surface at rest takes the place of `anatomy.mesh`. Empty: our own finite elements."""
    unit_mm: Positive | None = None
    """Millimetres in the files' unit of length: 1000 for m."""
    unit_mn: Positive | None = None
    """Millinewtons in the files' unit of force: 1000 for N. Needed with `force`."""
    dt_s: Positive | None = None
    """Seconds from one state to the next, where the files carry no time."""
    force: str | None = None
    """Force on the surface from outside: nodal:NAME, a field of forces on nodes; traction:NAME, of forces per
    area; or a table (.csv, in the files' folder) of time, fx, fy, fz and x, y, z of the contact at rest,
    spread over `fem.footprint_mm`. Empty: it is not known, and sequences have no label."""
    instruments: str | None = None
    """Instruments to draw, of the kinds in `fem.instrument`: a table (.csv, in the files' folder) of time,
    and x0, y0, z0 of the first one's tip and u0, v0, w0 from it to the hand. Empty: none is drawn."""


Family = Literal["healthy", "hyperaemic", "pale", "oedematous", "calf"]


class AppearanceSection(Section):
    """The appearance of the surface."""

    families: tuple[Family, ...] = ("healthy",)
    """Appearance families that sequences are drawn from, in equal shares."""
    photo: Path | None = None
    """A photograph used as albedo, or a folder of which each sequence draws one, relative to the job file.
    Empty: procedural vessels and parenchyma."""
    blood: Range[Share] | None = None
    """Blood on the rim, from none (0) to soaked (1). Empty: that of the family."""


class FlowSection(Section):
    """Recovery of flow from the video."""

    backend: Annotated[PlugInName, AfterValidator(ESTIMATORS.check_name)] = "tvl1"
    """Flow estimator: tvl1, opencv-tvl1, dis or that of an installed plug-in; `ideal`: no flow is
    recovered."""


def _among(known: tuple[str, ...]) -> AfterValidator:
    def check(names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if name not in known:
                raise ValueError(f"{name} is not among {', '.join(known)}{did_you_mean(name, known)}")
        return names

    return AfterValidator(check)


class StoreSection(Section):
    """The fields stored of every sequence. docs/fields.md lists them with their sizes."""

    extra: Annotated[tuple[str, ...], _among(EXTRA)] = ()
    """Fields to store in addition to the usual ones."""
    without: Annotated[tuple[str, ...], _among(SPARED)] = ()
    """Fields not to store: any of depth, flow_confidence, and of the right camera flow_right, visible_right,
    depth_right."""
    flow: Literal["float32", "float16"] = "float32"
    """Stored type of true and recovered flow; float16 rounds motion below 16 px by at most 0.004 px, below 32
    by 0.008."""


class CardSection(Section):
    """Texts of the dataset's card. They change no sequence."""

    title: str = "Synthetic neurosurgical sequences with ground-truth force"
    """Name of the dataset."""
    summary: str | None = None
    """The purpose of the dataset."""
    licence: str | None = "cc-by-4.0"
    """Licence under which you share it, as an SPDX name. Empty: none."""
    authors: tuple[str, ...] = ("made with Sulcus, maker not named",)
    """Authors of the dataset."""


_WITH_SERIES = {"young_kpa", "poisson", "footprint_mm", "instrument"}
"""Keys of `fem` that mean something where another program's files hold the motion."""


def _list_changed(section: Section) -> set[str]:
    """Keys of a section with other values than by default."""
    fields = type(section).model_fields.items()
    return {key for key, field in fields if getattr(section, key) != field.default}


class Job(Section):
    """One dataset."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of all random draws. The same job gives the same bytes."""
    sequences: Annotated[int, Field(ge=1, le=1_000_000)] = 24
    """Number of sequences."""
    frames: Annotated[int, Field(ge=3, le=10_000)] = 24
    """Frames per sequence; the first is the rest frame, in the last the tissue is released."""
    fps: Annotated[FiniteFloat, Field(gt=0, le=100_000)] = 25.0
    """Frames per second of the recorded video."""
    anatomy: AnatomySection = AnatomySection()
    mechanics: MechanicsSection = MechanicsSection()
    appearance: AppearanceSection = AppearanceSection()
    light: LightSection = LightSection()
    sensor: SensorSection = SensorSection()
    fem: FemSection = FemSection()
    render: RenderSection = RenderSection()
    flow: FlowSection = FlowSection()
    randomize: Groups = Groups()
    """Domain randomisation, wider than reality: groups, each with its strength from 0 (off) to 1, such as
    {texture: 1, light: 0.5}. A group draws its keys anew for every sequence and replaces the job's values of
    them. Needs a procedural block for `field`."""
    store: StoreSection = StoreSection()
    labels: Literal["published", "none"] = "none"
    """Noise on the field `intensity`: that of the published method's first stage, or none, as in its
    published code. `intensity` and `flow_noisy` have that of its second stage in any case; see
    `store.extra`."""
    card: CardSection = CardSection()

    @model_validator(mode="after")
    def _surface_and_fields_suit_the_picture(self) -> Job:
        if "vertices" not in self.anatomy.model_fields_set:
            width, height = self.render.size
            vertices = min(max(width * height // 4, 6000), self.anatomy.vertices)
            anatomy = self.anatomy.model_copy(update={"vertices": vertices})
            anatomy.model_fields_set.discard("vertices")  # so that they follow a later change of the size
            object.__setattr__(self, "anatomy", anatomy)
        fixed = self.anatomy.mesh, self.mechanics.source, self.render.calibration, self.fem.instrument_list
        if self.randomize.get("field") and any(fixed):
            needs = "a procedural block, a camera without calibration, and no fem.instrument_list"
            raise ValueError(f"randomize.field: needs {needs}")
        if self.randomize.get("instruments") and self.mechanics.source is not None:
            raise ValueError("randomize.instruments: idle ones may be in the way of mechanics.source")
        right = [name for name in self.store.extra if name.endswith("_right")]
        if right and self.render.stereo_mm == 0:
            raise ValueError(f"store.extra: {right[0]} needs a right camera; set render.stereo_mm")
        return self

    @model_validator(mode="after")
    def _mechanics_are_ours_or_not(self) -> Job:
        if self.mechanics.source is None:
            if used := _list_changed(self.mechanics):
                raise ValueError(f"mechanics.{min(used)} needs mechanics.source")
            return self
        craniotomy = self.anatomy.craniotomy
        if craniotomy.point is None or craniotomy.direction is None or self.anatomy.mesh is not None:
            raise ValueError("mechanics.source needs craniotomy.point and direction, and no anatomy.mesh")
        if self.mechanics.force is None and (labels := {"intensity", "flow_noisy"} & set(self.store.extra)):
            raise ValueError(f"store.extra: {min(labels)} needs mechanics.force")
        if lost := _list_changed(self.anatomy) & {"fill_holes", "dome_mm", "attachments"}:
            raise ValueError(
                f"anatomy.{min(lost)} is not used: the files of mechanics.source hold the motion"
            )
        default_fem = FemSection(
            instrument=self.fem.instrument
        )  # whose gestures are those of the instruments
        derived = {"gestures"} if self.fem.gestures == default_fem.gestures else set[str]()
        if unused := _list_changed(self.fem) - _WITH_SERIES - derived:
            raise ValueError(f"fem.{min(unused)} is not used: the files of mechanics.source hold the motion")
        if self.mechanics.force is not None and self.fem.young_kpa[0] != self.fem.young_kpa[1]:
            raise ValueError("mechanics.force needs one value of fem.young_kpa, that of the files' tissue")
        return self

    @model_validator(mode="after")
    def _instruments_fit_opening_and_sequence(self, info: ValidationInfo) -> Job:
        radius, lines = self.anatomy.craniotomy.radius_mm, []
        for name, loads in () if info.context is STORED else self.fem.load_ranges:
            if (footprint_mm := loads.footprint_mm[0]) > radius:
                key = f"fem.{name.replace(': ', '.')}footprint_mm"
                raise ValueError(
                    f"{key}: {footprint_mm:g} mm is wider than an opening of {radius:g} mm radius"
                )
        for k, line in enumerate(self.fem.instrument_list):
            try:
                lines.append(line.scale_timing(self.frames, self.fps))
            except ValueError as error:
                raise ValueError(f"fem.instrument_list[{k}].{error}") from None
            footprint_mm = self.fem.load_range(line).footprint_mm[0]
            if line.place is not None and math.hypot(*line.place) + footprint_mm + CLEAR_MM > radius:
                raise ValueError(
                    f"fem.instrument_list[{k}].place: {math.hypot(*line.place):.3g} mm from the centre, a "
                    f"contact of {footprint_mm:g} mm radius reaches under the rim of an opening of "
                    f"{radius:g} mm"
                )
        fem = self.fem.model_copy(update={"instrument_list": tuple(lines)})
        object.__setattr__(self, "fem", fem)
        return self

    @property
    def stored_fields(self) -> tuple[str, ...]:
        """Names of the fields in its sequences, in the order of the field table."""
        recovered, stereo = self.flow.backend != "ideal", self.render.stereo_mm > 0
        several = max(self.fem.instruments[1], len(self.fem.instrument_list)) > 1
        loaded = self.mechanics.source is None or self.mechanics.force is not None
        conditions = {"loaded": loaded, "several": several, "recovered": recovered, "stereo": stereo}
        kinds = {"always", "usually", *(kind for kind, holds in conditions.items() if holds)}
        kinds |= {"stereo recovered"} if stereo and recovered else set()
        fields = [
            field for field in FIELDS.values() if field.stored in kinds or field.name in self.store.extra
        ]
        return tuple(field.name for field in fields if field.name not in self.store.without)
