"""Scenario of one sequence: every number drawn for it, part by part; `draw` puts it together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError
from synth.fem import tool_gesture
from synth.fem.material import Pia, Tissue
from synth.fem.pulse import BREATH_HZ, HEART_HZ, Pulse
from synth.fem.tool_gesture import Drive, Gesture, ToolContact
from synth.job import schema
from synth.job.mechanics_sections import (
    CLEAR_MM,
    DRIVEN_SIZES_MM,
    Contact,
    Instrument,
    InstrumentSection,
    name_of,
)
from synth.job.microscope import BLUR_WIDTH_PX
from synth.job.schema import Family, FemSection, Job, LightSection, RenderSection
from synth.render import instrument
from synth.render.anatomy.surface import Relief
from synth.render.appearance.family import FAMILIES, Appearance, Colour
from synth.render.appearance.light import Lighting, balance
from synth.render.camera.camera import CameraView
from synth.render.camera.camera_motion import CameraMotion
from synth.render.camera.camera_sensor import CameraSensor
from synth.render.camera.colour_processing import CAMERAS
from synth.render.finish_maps import RING
from synth.render.idle import IdleInstrument
from synth.render.instrument import OwnMesh
from synth.render.randomized.surroundings import Randomization
from synth.sequence.job_instruments import read_job_instruments

Random = np.random.Generator
Range = tuple[float, float]

_STRETCH = 1.01, 1.03
"""Pre-stretch of a membrane. Not measured: its tension then balances a pressure of 3-350 Pa (at most 2.6
mmHg) under a dome of 70 mm radius, which is plausible in a living head."""
_RAMP = 0.25, 0.35  # time over which the load grows to its peak, as a part of the sequence
ATTEMPTS = 4  # draws of a sequence's gestures, each where the mesh did not bear those before
DRIVEN_ATTEMPTS = 12  # likewise, of driven instruments, whose range is found while solving
_TRIES, _ROUNDS = 400, 8  # draws of a gesture until it fits, and of all gestures of `fem.instrument_list`
_END_ON_DEG, _APART_MM = 25.0, 3.0  # least angle of a shaft to the line of sight; gap between instruments
_RINGS = 4  # every fourth ring of an instrument is compared with those of others
_ROUND = "suction", "probe", "none"
_TIP_LENGTH = 1.5  # of a driven end that presses, over its width
_CLOSING = 0.1, 0.4  # part by which the fold between two tips is closed
_HOLDS = {"pull": 0.9, "grasp": 0.8, "push": 0.75, "tap": 0.55, "retract": 0.7}
"""Longest way of a driven contact over its size, the root of length times width: about where a det F of 0.2
ends most of them."""
_FRAMES: int = Job.model_fields["frames"].default  # of a sequence, where no job states them
_SPARSE_DEG = 17.0  # slope that mirrors the main lamp into the lens where highlights are fewest
_KELVIN = 4200.0, 5600.0  # colour temperature of the lamps
_POWER = 0.95, 1.1  # illumination, relative to one that just fills the sensor with white
_DRIFT = 0.0, 0.03  # largest change of power over the sequence, as a share of it
_SHOWN = {
    "retractor": 0.3,
    "bone": 0.5,
    "drape": 0.4,
    "clips": 0.55,
    "hooks": 0.3,
    "patties": 0.35,
}  # shares of the sequences that show a part


@dataclass(frozen=True)
class Scenario:
    """One sequence as drawn, before any computation. `as_dict` is ready for JSON."""

    index: int
    """Position in the dataset."""
    family: str
    """Appearance family."""
    relief: Relief
    """Shape and vessels of the anatomy, with its own seed."""
    tissue: Tissue
    gestures: tuple[Gesture, ...]
    """Gestures of the instruments, all at the same time; none where no instrument is shown."""
    appearance: Appearance
    view: CameraView
    camera_motion: CameraMotion
    pulse: Pulse | None
    """Pulse of heart and breath; None where only instruments move the tissue."""
    idle: tuple[IdleInstrument, ...] = ()
    """Instruments that touch nothing."""
    randomized: Randomization | None = None
    """What `Job.randomize` draws beyond the job's own keys; None without it."""
    attempt: int = 0
    """Number of earlier draws of its gestures, whose loads the mesh did not bear."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def draw_relief(anatomy: schema.AnatomySection, rng: Random) -> Relief:
    """Draws seed and shape of one anatomy."""
    seed = int(rng.integers(2**31))
    return Relief(seed, _uniform(rng, anatomy.gyrus_mm), _uniform(rng, anatomy.sulcus_mm))


def draw_tissue(fem: FemSection, rng: Random) -> Tissue:
    """Draws the tissue; E log-uniformly, so that half and twice the stiffness are equally likely."""
    law, why = fem.chosen_law
    young = _log_uniform(rng, fem.young_kpa)
    # Drawn even where unused, so that other numbers do not depend on whether there is a membrane.
    chance, membrane = rng.uniform(), fem.membrane
    stiff, thick = _log_uniform(rng, membrane.young_kpa), _uniform(rng, membrane.thickness_mm)
    stretch = _uniform(rng, _STRETCH)
    poisson, skull = _uniform(rng, fem.poisson), str(rng.choice(fem.skull))
    alpha = _uniform(rng, fem.alpha)
    pia = Pia(stiff, thick, stretch, _uniform(rng, membrane.stiffening))  # the last one drawn
    return Tissue(young, poisson, law, why, pia if chance < membrane.probability else None, skull, alpha)


def draw_pulse(pulse: schema.PulseSection, rng: Random) -> Pulse | None:
    """Draws amplitudes, rates and phases uniformly; None without motion."""
    turn = 0, 2 * np.pi
    heart, breath = (pulse.heart_mm, HEART_HZ, turn), (pulse.breath_mm, BREATH_HZ, turn)
    drawn_pulse = Pulse(*(_uniform(rng, ends) for ends in (*heart, *breath)))
    return drawn_pulse if drawn_pulse.heart_mm or drawn_pulse.breath_mm else None


def draw_gestures(
    fem: FemSection,
    opening_mm: float,
    young_kpa: float,
    rng: Random,
    others: Random,
    visible_mm: float = np.inf,
    lens: Floats = np.array([0.0, 0.0, 300.0]),
    frames: int = _FRAMES,
) -> tuple[Gesture, ...]:
    """Draws the gestures of all instruments, each again until it fits next to the others.

    Those of `fem.instrument_list` have the values given there; those with a place are drawn first, so that no
    other instrument occupies it. `rng`: of this sequence's first gesture, `others`: of its further ones;
    `visible_mm`: see `draw_gesture`; `lens`: (3,) mm, world axes, no instrument is end-on before it.

    Raises UserError if not all instruments fit into the opening, or not in their places.
    """
    named_sections, (fewest, most), meshes = fem.instrument_list, fem.instruments, read_job_instruments(fem)
    target_count = max(int(others.integers(fewest, most + 1)), len(named_sections))
    sight, least_cosine = lens / np.linalg.norm(lens), np.cos(np.radians(_END_ON_DEG))
    # Each time all anew: the shaft of one may be in the way of the next. At last fewer, if the job allows it.
    for count in (
        *[target_count] * _ROUNDS,
        *range(target_count - 1, max(fewest, len(named_sections)) - 1, -1),
    ):
        sections = [*named_sections, *[InstrumentSection()] * (count - len(named_sections))]
        order, placed_gestures = (
            sorted(range(count), key=lambda k: sections[k].place is None),
            dict[int, Gesture](),
        )
        for k in order:
            for _ in range(_TRIES):
                generator = others if k else rng
                if fem.contact == ("driven",):
                    trial = draw_driven_gesture(fem, opening_mm, generator, sections[k], visible_mm, frames)
                else:
                    trial = draw_gesture(
                        fem, opening_mm, young_kpa, generator, sections[k], visible_mm, frames
                    )
                longest = np.linalg.norm(trial.axes, axis=1).max()
                limit_mm = max(opening_mm - CLEAR_MM, longest) if named_sections else opening_mm
                fits = trial.reach_mm <= min(limit_mm, opening_mm) + 1e-9
                hides = trial.shaft @ sight > least_cosine and trial.instrument != "none"
                apart = (_are_apart(trial, other, meshes) for other in placed_gestures.values())
                if fits and not hides and all(apart):
                    placed_gestures[k] = trial
                    break
            else:
                break
        else:
            return tuple(placed_gestures[k] for k in range(count))
    neighbours = f" next to {len(placed_gestures)} others" if placed_gestures else ""
    key = "instrument_list" if named_sections else "instruments"
    raise UserError(
        f"fem.{key}: instrument {k + 1} of {count} does not fit{neighbours} "
        f"into an opening of {opening_mm:g} mm radius; lower fem.instruments or footprint_mm, change "
        "its place or direction, or widen anatomy.craniotomy.radius_mm or render.field_mm"
    )


def draw_gesture(
    fem: FemSection,
    opening_mm: float,
    young_kpa: float,
    rng: Random,
    section: InstrumentSection = InstrumentSection(),
    visible_mm: float = np.inf,
    frames: int = _FRAMES,
) -> Gesture:
    """Draws one gesture: contact uniformly in the opening, direction in its cone, unless `section` gives it.

    Its contacts stay within the opening and within `visible_mm` of its middle, which the camera shows of a
    wide one; a gesture too large for that is in the middle. With a given place it may reach beyond.
    """
    preferred, ranges, extra_rng = str(rng.choice(fem.gestures)), fem.load_range(section), rng.spawn(1)[0]
    choices = fem.choices(section)
    kind = preferred if preferred in choices else list(choices)[int(extra_rng.integers(len(choices)))]
    tools = choices[kind]
    tool = name_of(list(tools)[int(extra_rng.choice(len(tools), p=list(tools.values())))])
    footprint = _uniform(rng, ranges.footprint_mm)
    unit_mn = young_kpa * footprint**2  # the force of P = 1
    load = _uniform(rng, ranges.load) if ranges.force_mn is None else _uniform(rng, ranges.force_mn) / unit_mn
    spread = footprint * _uniform(rng, (1.2, 1.8) if kind == "grasp" else (0.1, 0.4))
    path = _uniform(rng, (3, 8)) if kind == "slide" else 0.0
    azimuth = _uniform(rng, (0, 360))
    half = path if kind == "slide" else spread if kind == "grasp" else 0.0
    elongation = tool_gesture.aspect_ratio(kind, tool)
    reach = footprint * np.sqrt(max(elongation, 1 / elongation)) + 0.5 * half
    # The middle of the contacts; a circle of `reach` around it lies in opening and picture.
    largest = max(min(opening_mm - reach - CLEAR_MM, visible_mm - reach), 0.0)
    radius, angle = largest * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    point = radius * np.array([np.cos(angle), np.sin(angle)])
    if section.place is not None:
        point = np.asarray(section.place, np.float64)
    along, direction = _draw_direction(fem, kind, rng, section)
    if kind == "retract":  # the hand is on the side that tissue is drawn to, in a quarter of them opposite
        turn = np.degrees(np.arctan2(along[1], along[0])) + 180 * (extra_rng.random() < 0.25)
        azimuth = float((turn + _uniform(extra_rng, (-30, 30))) % 360)
    places, directions = tool_gesture.grip(kind, point - 0.5 * path * along, direction, spread, azimuth)
    total_force = load * unit_mn * directions.sum(axis=0)
    contact_forces = zip(places.tolist(), load * unit_mn * directions, strict=True)
    drawn_timing = _draw_timing(kind, rng, frames)
    touch, full, fall, release = map(float, section.timing or drawn_timing)
    return Gesture(
        kind=kind,
        instrument=tool,
        contacts=tuple(ToolContact((x, y), _vector(part)) for (x, y), part in contact_forces),
        footprint_mm=footprint,
        load=load,
        point_mm=(float(point[0]), float(point[1])),
        direction=_vector(total_force / np.linalg.norm(total_force)),
        force_mn=float(np.linalg.norm(total_force)),
        path_mm=(float(path * along[0]), float(path * along[1])),
        azimuth_deg=azimuth,
        elevation_deg=_uniform(rng, (35, 65)),
        spread_mm=spread,
        hover_mm=_uniform(rng, (6, 12)),
        taps=min(int(rng.integers(2, 4)), max((frames - 1) // 3, 1)) if kind == "tap" else 1,
        timing=(touch, full, fall, release),
    )


def draw_driven_gesture(
    fem: FemSection,
    opening_mm: float,
    rng: Random,
    section: InstrumentSection = InstrumentSection(),
    visible_mm: float = np.inf,
    frames: int = _FRAMES,
) -> Gesture:
    """Draws a gesture of an instrument that holds the tissue and moves it, as `draw_gesture`.

    Sizes are drawn from those of instruments; the way is at most that over which a contact of its size holds.
    """
    choices = fem.choices(section)
    kinds = [kind for kind in fem.gestures if kind in choices] or list(choices)
    kind = kinds[int(rng.integers(len(kinds)))]
    tools = choices[kind]
    chosen_tool = list(tools)[int(rng.choice(len(tools), p=list(tools.values())))]
    tool, size_name = name_of(chosen_tool), chosen_tool if isinstance(chosen_tool, str) else "none"
    length, width = _draw_size(kind, size_name, rng, section)
    mean = float(np.sqrt(length * width))  # of the fold that a grasp holds
    spread, closing, reach = 0.1 * width, 0.0, 0.5 * float(np.hypot(length, width))
    if kind == "grasp":  # each tip holds a half of it
        width *= 0.5
        spread, closing = width, 0.5 * width * _uniform(rng, _CLOSING)
    largest = max(min(opening_mm - reach - CLEAR_MM, visible_mm - reach), 0.0)
    radius, angle = largest * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    point = radius * np.array([np.cos(angle), np.sin(angle)])
    if section.place is not None:
        point = np.asarray(section.place, np.float64)
    along, direction = _draw_direction(fem, kind, rng, section)
    azimuth = _uniform(rng, (0, 360))
    if kind == "retract":  # the hand is on the side that tissue is drawn to
        azimuth = float((np.degrees(np.arctan2(along[1], along[0])) + _uniform(rng, (-30, 30))) % 360)
    travel, force = _draw_travel(fem, _HOLDS[kind] * mean, rng, section)
    places, _ = tool_gesture.grip(kind, point, direction, spread, azimuth)
    touch, full, fall, release = map(float, section.timing or _draw_timing(kind, rng, frames))
    return Gesture(
        kind=kind,
        instrument=tool,
        contacts=tuple(ToolContact((float(x), float(y)), (0.0, 0.0, 0.0)) for x, y in places),
        footprint_mm=0.5 * float(np.sqrt(length * width)),
        load=0.0,
        point_mm=(float(point[0]), float(point[1])),
        direction=_vector(direction),
        force_mn=force or 0.0,
        path_mm=(0.0, 0.0),
        azimuth_deg=azimuth,
        elevation_deg=_uniform(rng, (35, 65)),
        spread_mm=spread,
        hover_mm=_uniform(rng, (6, 12)),
        taps=min(int(rng.integers(2, 4)), max((frames - 1) // 3, 1)) if kind == "tap" else 1,
        timing=(touch, full, fall, release),
        drive=Drive(travel, force, closing, (length, width), yields=section.travel_mm is None),
    )


def _draw_size(
    kind: str, size_name: Instrument, rng: Random, section: InstrumentSection
) -> tuple[float, float]:
    """Length and width [mm] of what an instrument holds; `size_name`: its name among `DRIVEN_SIZES_MM`."""
    length, width = (_uniform(rng, ends) for ends in DRIVEN_SIZES_MM[size_name])
    if size_name in _ROUND:
        width = length
    elif kind in ("push", "tap"):
        length = min(length, _TIP_LENGTH * width)  # it presses with its end
    if section.footprint_mm is not None:
        scale = 2 * _uniform(rng, section.footprint_mm) / np.sqrt(length * width)
        length, width = scale * length, scale * width
    return length, width


def _draw_travel(
    fem: FemSection, holds_mm: float, rng: Random, section: InstrumentSection
) -> tuple[float | None, float | None]:
    """Travel [mm], at most `holds_mm` unless it is given, or instead of it the force [mN] to be reached."""
    quantile = rng.uniform()
    ranges = section if section.travel_mm or section.force_mn else fem
    if ranges.force_mn is not None:
        low, high = ranges.force_mn
        return None, float(low * (high / low) ** quantile)
    low, high = ranges.travel_mm or (0.0, 0.0)
    if section.travel_mm is None:  # one that is named is as given
        low, high = min(low, holds_mm), min(high, holds_mm)
    log = fem.travel_scale == "log"
    return float(low * (high / low) ** quantile if log else low + quantile * (high - low)), None


def _are_apart(gesture: Gesture, other: Gesture, meshes: Mapping[str, OwnMesh]) -> bool:
    """Whether two gestures' contacts and instruments are apart, on their whole ways over level tissue."""
    if tool_gesture.clearance(gesture, other) < 0:
        return False
    (rings, radii), (other_rings, other_radii) = (
        _rings(acting, meshes.get(acting.instrument)) for acting in (gesture, other)
    )
    gap = np.linalg.norm(rings[:, None] - other_rings[None], axis=2) - radii[:, None] - other_radii[None]
    return float(gap.min(initial=np.inf)) >= _APART_MM


@lru_cache(maxsize=64)
def _rings(gesture: Gesture, mesh: OwnMesh | None = None) -> tuple[Floats, Floats]:
    """Middles (N, 3) mm and radii (N,) mm of the instrument's rings before, at the start and at the end."""
    if mesh is None:
        parts, _ = instrument.shape_of(gesture.instrument, gesture.footprint_mm)
    else:
        parts = (mesh.outline,)
    shapes = [np.zeros((0, 3))]
    for slide, hover in product((-0.5, 0.5) if any(gesture.path_mm) else (0.0,), (0.0, gesture.hover_mm)):
        place = gesture.point_mm + slide * np.asarray(gesture.path_mm)
        tips = np.column_stack([place + gesture.sides, np.zeros(2)]) + hover * gesture.shaft
        shapes += instrument.place(parts, tips, np.stack([gesture.shaft] * 2))
    rings = np.concatenate(shapes).reshape(-1, RING, 3)[::_RINGS]
    middles = rings.mean(axis=1)
    return middles, np.linalg.norm(rings - middles[:, None], axis=2).max(axis=1)


def _draw_direction(
    fem: FemSection, kind: str, rng: Random, section: InstrumentSection
) -> tuple[Floats, Floats]:
    """Unit vectors: of the load along the surface (2,), the direction of a slide, and of the load (3,)."""
    turn = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(turn), np.sin(turn)])
    cone = np.cos(np.radians(fem.max_tilt_deg))
    rise = rng.uniform(cone, 1.0)
    if kind == "retract":  # sideways, as a spatula holds tissue away
        rise = rng.uniform(0.1, max(cone, 0.3))
    elif kind == "slide":
        rise = 1 / np.hypot(1, tool_gesture.FRICTION)
    if section.direction is not None:
        unit = np.asarray(section.direction) / np.linalg.norm(section.direction)
        along = unit[:2] / (np.hypot(*unit[:2]) or 1.0)
        rise = rise if kind == "slide" else abs(float(unit[2]))
    up = rise if kind in ("pull", "grasp") else -rise
    return along, np.append(np.sqrt(1 - rise**2) * along, up)


def choose(rng: Random, kinds: tuple[Contact, ...]) -> Contact:
    """One of several kinds, in equal shares."""
    return kinds[int(rng.integers(len(kinds)))]


def _draw_timing(kind: str, rng: Random, frames: int) -> tuple[float, float, float, float]:
    """Times of touch, full load, start of its fall, and release, as parts of the sequence."""
    touch = _uniform(rng, (0.08, 0.15))
    full = touch + _uniform(rng, (0.1, 0.2) if kind == "tap" else _RAMP)
    release = _uniform(rng, (0.85, 0.92))
    hold = _uniform(rng, (0.5, 0.7) if kind in ("retract", "slide") else (0.15, 0.5))
    fall = full + hold * (release - full)
    if frames > 3:  # the first frame after that at rest has no contact, the next may have the whole load
        touch = max(touch, 1.01 / (frames - 1))
        full = max(full, touch + 0.05)
        fall = max(fall, full, min(2 / (frames - 1), release - 0.05))
    return touch, full, fall, release


def draw_view(render: RenderSection, rng: Random) -> CameraView:
    """Draws the microscope's pose and field; a calibration replaces the latter, see `camera.state_field`."""
    return CameraView(
        field_mm=_uniform(rng, render.field_mm),
        working_distance_mm=_uniform(rng, render.working_distance_mm),
        tilt_deg=_uniform(rng, render.tilt_deg),
        azimuth_deg=_uniform(rng, (0.0, 360.0)),
        roll_deg=_uniform(rng, (0.0, 360.0)),
        focus_mm=_uniform(rng, (-0.5, 0.5)),
    )


def draw_camera_motion(render: RenderSection, rng: Random) -> CameraMotion:
    """Draws the drift of the microscope."""
    return CameraMotion(_uniform(rng, render.drift_mm), int(rng.integers(2**31)))


def draw_appearance(job: Job, family: Family, rng: Random) -> Appearance:
    """Draws an appearance of `family`, with the job's light and sensor."""
    lighting = draw_light(job.light, rng)
    ranges = vars(FAMILIES[family])
    if job.appearance.blood:
        ranges = ranges | {"blood": job.appearance.blood}
    values: dict[str, Any] = {
        name: _vary_colour(ends, rng) if len(ends) == 3 else _uniform(rng, ends)
        for name, ends in ranges.items()
    }
    # More glare: a thicker and rougher layer of a higher index, over more relief. Chosen on photographs.
    square = lighting.glare**2
    values["fluid_smoothing_mm"] += 0.14 * square
    values["bump"] *= 1 + 3 * square
    values["roughness"] += 0.12 * square
    values["dry_roughness"] *= 1 - 0.6 * lighting.glare
    appearance = Appearance(
        family=family,
        **values,
        fluid_index=1.33 + 0.47 * square,
        scenery=(),
        rim_seed=int(rng.integers(2**31)),
        light=lighting,
        sensor=draw_sensor(job.sensor, balance(lighting.kelvin + rng.uniform(-250, 350)), rng),
    )
    # By seeds of their own, so that no other number depends on them.
    blur = _uniform(np.random.default_rng([appearance.rim_seed, 5]), job.sensor.blur_px)
    sensor = replace(appearance.sensor, blur=blur * job.render.size[0] / BLUR_WIDTH_PX)
    parts = job.render.scenery
    chance = np.random.default_rng([appearance.rim_seed, 4]).random(len(parts))
    scenery = tuple(part for part, level in zip(parts, chance, strict=True) if level < _SHOWN[part])
    return replace(appearance, sensor=sensor, scenery=scenery)


def draw_light(light: LightSection, rng: Random) -> Lighting:
    """Draws the lamps' positions, power and colour."""
    glare, azimuth, tilt = _uniform(rng, light.glare), _uniform(rng, (-1, 1)), light.tilt_deg
    return Lighting(
        glare=glare,
        mirror_deg=_SPARSE_DEG * (1 - glare),
        tilt_deg=None if tilt is None else _uniform(rng, tilt),
        azimuth_deg=azimuth * (50.0 if tilt is None else 180.0),
        main=_uniform(rng, light.main),
        power=_uniform(rng, _POWER),
        kelvin=_uniform(rng, _KELVIN),
        even=_uniform(rng, light.even),
        drift=_uniform(rng, _DRIFT),
        phase=_uniform(rng, (0, 2 * np.pi)),
    )


def draw_sensor(section: schema.SensorSection, white: Colour, rng: Random) -> CameraSensor:
    """Draws a sensor with that white balance; colours of the job, or else of a drawn camera."""
    sensor = CameraSensor(
        exposure=_uniform(rng, section.exposure),
        white=white,
        full_well=_uniform(rng, section.full_well),
        read_noise=_uniform(rng, section.read_noise),
        vignette=section.vignette,
        sharpening=_uniform(rng, section.sharpening),
        chroma=section.chroma,
        coded=section.bitrate_mbps is not None,
    )
    camera = CAMERAS[int(rng.integers(len(CAMERAS)))]
    return replace(sensor, matrix=section.matrix or camera.matrix, curves=section.curves or camera.curves)


def _vary_colour(colour: Colour, rng: Random) -> Colour:
    """A colour of slightly different brightness and hue."""
    value = np.asarray(colour) * rng.uniform(0.94, 1.05) * rng.uniform(0.96, 1.04, 3)
    return _vector(np.clip(value, 0.01, 0.95))


def _uniform(rng: Random, ends: Range) -> float:
    return float(rng.uniform(*ends))


def _log_uniform(rng: Random, ends: Range) -> float:
    return float(np.exp(rng.uniform(*np.log(ends))))


def _vector(value: Floats) -> tuple[float, float, float]:
    return float(value[0]), float(value[1]), float(value[2])
