"""Gestures: the load of an instrument on the tissue, and its pose in every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from synth.arrays import Array, Floats, Ints
from synth.errors import UserError
from synth.geometry.triangles import Shape, side_areas
from synth.plugins import check_answer

_PINCH = 0.5  # force of a grasp's tips towards each other, as a part of their pull
FRICTION = 0.4  # drag of a sliding tip, as a part of its push
CLOSED_MM = 2.0  # way of a driven grasp after which its tips are closed
_OVERLAP = 0.6  # least distance of contacts over their radii's sum: together they peak at 1.1 of one's peak
_RING = 0.6  # radius of a ring's largest pressure over its own
_RING_SIZE = (32 / 5 * _RING * (1 - _RING)) ** -0.5  # radius over that of a round contact of its area
_ASPECTS = {"forceps": 2.0, "bayonet": 2.0, "spatula": 0.5}  # a tine's line, a blade's edge
_FACE = 0.7  # of a blade that retracts: length along the instrument over width


@dataclass(frozen=True)
class ToolContact:
    """One place where a tip loads the tissue."""

    point_mm: tuple[float, float]  # world x, y of its centre at rest
    force_mn: tuple[float, float, float]  # force on the tissue at full load, world axes


@dataclass(frozen=True)
class Drive:
    """The way of an instrument that holds the tissue under its tips and moves it; see `driven_contact`."""

    travel_mm: (
        float | None
    )  # way of its tips at the peak, along the gesture's direction; None: force_mn decides
    force_mn: float | None  # peak of the reaction, found by driving
    closing_mm: float  # way of each tip of a grasp towards the other
    size_mm: tuple[float, float]  # of a contact, along and across the instrument
    yields: bool = False  # whether it ends earlier where tissue bears no more; else that is an error


@dataclass(frozen=True)
class Gesture:
    """Gesture of one instrument in a sequence."""

    kind: str  # `pull`, `push`, `slide`, `grasp`, `retract` or `tap`
    instrument: str  # `forceps`, `bayonet`, `dissector`, `suction`, `spatula`, `probe`; `none` is not drawn
    contacts: tuple[ToolContact, ...]  # A grasp has two, the others one
    footprint_mm: float  # radius a of every contact; that of a circle of its area where it is not round
    load: float  # peak P = F/(E a^2) of a contact
    point_mm: tuple[float, float]  # world x, y of the middle of the contacts at rest
    direction: tuple[float, float, float]  # unit vector of the whole load, world axes
    force_mn: float  # peak of the whole force
    path_mm: tuple[float, float]  # world x, y that a slide covers; else 0
    azimuth_deg: float  # side of the hand, counter-clockwise from world x
    elevation_deg: float  # angle of the instrument above the surface
    spread_mm: float  # distance between the two tips
    hover_mm: float  # distance of the tips from the tissue in the rest frame
    taps: int  # number of times that the load comes and goes
    timing: tuple[float, float, float, float]  # touch, full load, start of its fall, release: sequence parts
    drive: Drive | None = None  # of a contact that is driven: loads and forces above are then 0 if not given

    def tip_offsets(self, travel_mm: float) -> Floats:
        """Offsets (C, 3) mm of its tips `travel_mm` along its path; tips of a grasp close first."""
        offsets = np.tile(travel_mm * np.asarray(self.direction), (len(self.contacts), 1))
        if self.drive is not None and len(self.contacts) == 2:
            offsets[:, :2] -= self.drive.closing_mm * _smooth(travel_mm / CLOSED_MM) * _unit(self.sides)
        return offsets

    @property
    def axes(self) -> Floats:
        """Half axes (2, 2) mm of its contacts along and across the instrument, world x and y.

        All forms have the area of a circle of radius a, so that P means the same largest pressure.
        """
        turn = np.radians(self.azimuth_deg)
        if self.drive is not None:
            size = 0.5 * np.asarray(self.drive.size_mm)
        else:
            along = aspect_ratio(self.kind, self.instrument)
            size = self.footprint_mm * np.sqrt([along, 1 / along])
            size *= _RING_SIZE if self.instrument == "suction" else 1.0
        return np.asarray(size[:, None] * [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

    @property
    def reach_mm(self) -> float:
        """Largest distance of loaded tissue from the opening's middle."""
        return max(float(np.hypot(x, y)) + radius for x, y, radius in self.focus)

    @property
    def focus(self) -> tuple[tuple[float, float, float], ...]:
        """Places where the mesh should be finest: x, y and radius of circles in the contacts, mm."""
        wide, long = sorted(self.axes, key=np.linalg.norm)
        radius, end = float(np.linalg.norm(wide)), long * (1 - np.linalg.norm(wide) / np.linalg.norm(long))
        stops = (0.0, 0.5, 1.0) if any(self.path_mm) else (0.0,)
        sides = (-1, 0, 1) if end.any() else (0,)
        path = [s * np.asarray(self.path_mm) + e * end for s in stops for e in sides]
        places = [np.asarray(contact.point_mm) + step for contact in self.contacts for step in path]
        return tuple((float(x), float(y), radius) for x, y in places)

    @property
    def sides(self) -> Floats:
        """Vectors (2, 2) mm from the middle of the tips to each."""
        return np.outer((-1, 1), _aside(self.spread_mm, self.azimuth_deg))

    @property
    def shaft(self) -> Floats:
        """Unit vector from the tips to the hand, (3,) world axes."""
        turn, up = np.radians(self.azimuth_deg), np.radians(self.elevation_deg)
        return np.array([np.cos(turn) * np.cos(up), np.sin(turn) * np.cos(up), np.sin(up)])


@dataclass(frozen=True)
class ToolMotion:
    """The gesture over T frames. In frame 0 there is no load and the tips are `hover_mm` away."""

    load: Floats
    """(T,) as a part of the peak."""
    away: Floats
    """(T,) distance of the tips from the tissue, as a part of `hover_mm`."""
    shift: Floats
    """(T, 2) mm that the contacts have slid over the surface at rest."""


def aspect_ratio(kind: str, instrument: str) -> float:
    """Length of an instrument's contact along it over the width; 1 is round."""
    return _FACE if (kind, instrument) == ("retract", "spatula") else _ASPECTS.get(instrument, 1.0)


def grip(
    kind: str, point: Floats, direction: Floats, spread_mm: float, azimuth_deg: float
) -> tuple[Floats, Floats]:
    """Centres (C, 2) mm and load directions (C, 3), unit vectors, of an instrument's tips, two of a grasp.

    `point`: (2,) mm, middle of the contacts; `direction`: (3,) unit vector; else as in `Gesture`.
    """
    if kind != "grasp":
        return point[None], direction[None]
    aside = _aside(spread_mm, azimuth_deg)
    directions = []
    for inward in (aside, -aside):
        pinched = direction + _PINCH * np.append(inward, 0) / np.linalg.norm(inward)
        directions.append(pinched / np.linalg.norm(pinched))
    return np.stack([point - aside, point + aside]), np.stack(directions)


def clearance(gesture: Gesture, other: Gesture) -> float:
    """Distance of two gestures' contacts beyond the clearance they need, mm."""
    focus, other_focus = np.array(gesture.focus), np.array(other.focus)
    distance = np.linalg.norm(focus[:, None, :2] - other_focus[None, :, :2], axis=2)
    return float((distance - _OVERLAP * (focus[:, None, 2] + other_focus[None, :, 2])).min())


def trajectory(gesture: Gesture, frames: int) -> ToolMotion:
    """The gesture's own motion over T frames."""
    t = np.linspace(0, 1, frames)
    touch, full, fall, release = gesture.timing
    if gesture.taps > 1:
        phase = np.clip((t - touch) / (release - touch), 0, 1) * gesture.taps
        load = np.sin(np.pi * (phase % 1)) ** 2 * ((t > touch) & (t < release))
        lift = 0.15 * np.cos(np.pi * (phase % 1)) ** 2
    else:
        load = _smooth((t - touch) / (full - touch)) * (1 - _smooth((t - fall) / (release - fall)))
        lift = np.zeros(frames)
    away = 1 - _smooth(t / touch) + _smooth((t - release) / (1 - release))
    slide = _smooth((t - full) / max(fall - full, 1e-9))
    # The rest frame is the first one, whatever the timing.
    load[0] = 0.0
    shift = slide[:, None] * np.asarray(gesture.path_mm)
    return ToolMotion(load, np.maximum(away, lift * (load < 1e-3)), shift)


def check_motions(
    motions: Sequence[ToolMotion], gestures: Sequence[Gesture], frames: int
) -> list[ToolMotion]:
    """The motions; UserError unless each gesture has one over those frames, finite and at rest in frame 0."""
    if len(motions) != len(gestures):
        raise UserError(f"motions: {len(motions)} for the scene's {len(gestures)} instruments")
    for k, motion in enumerate(motions):
        for name, shape in (("load", (frames,)), ("away", (frames,)), ("shift", (frames, 2))):
            value = check_answer(f"motions[{k}]", name, getattr(motion, name), shape)
            if name != "away" and value[0].any():
                raise UserError(f"motions[{k}]: {name}: is not 0 in frame 0, the rest frame")
    return [
        ToolMotion(*(np.asarray(value, np.float64) for value in vars(motion).values())) for motion in motions
    ]


def tractions(gesture: Gesture, motion: ToolMotion, vertices: Floats, area: Floats) -> Floats:
    """Load (T, V, 3) kPa on the surface at rest, (V, 3) mm: sum(area * result) is the force; `area`: (V,)
    mm^2. Raises as `footprint`."""
    out = np.zeros((len(motion.load), len(vertices), 3))
    for contact in gesture.contacts:
        start = np.asarray(contact.point_mm)
        contact_args = gesture.axes, vertices, area, gesture.instrument == "suction"
        kernel = footprint(start, *contact_args)
        for t, part in enumerate(motion.load):
            if part > 0:
                if motion.shift[t].any():
                    kernel = footprint(start + motion.shift[t], *contact_args)
                out[t] += np.outer(part * kernel, contact.force_mn)
    return out


def footprint(
    centre: Floats, size: float | Floats, vertices: Floats, area: Floats, ring: bool = False
) -> Floats:
    """Pressure (V,) 1/mm^2 of a unit force: (1 - (r/a)^2)^2 on the surface, sum(area * result) = 1.

    `centre`: (2,) mm, world x, y; `size`: a [mm], or the half axes (2, 2) mm of an ellipse; `vertices`,
    `area`: (V, 3) mm at rest, (V,) mm^2; `ring`: the kernel is that of the distance from a ring in its outer
    part. UserError: fewer than 3 vertices lie under the contact.
    """
    distance = np.hypot(*(vertices[:, :2] - centre).T)
    middle = np.append(centre, vertices[distance.argmin(), 2])
    axes = np.eye(3)
    axes[:2, :2] = size if np.ndim(size) else size * np.eye(2)
    radius_mm = axes[2, 2] = float(np.sqrt(np.linalg.det(axes)))
    reach = np.linalg.norm((vertices - middle) @ np.linalg.inv(axes), axis=1)
    if ring:
        reach = np.abs(reach - _RING) / (1 - _RING)
    kernel = (1 - np.minimum(reach, 1) ** 2) ** 2
    total = float(kernel @ area)
    if np.count_nonzero(kernel) < 3 or total <= 0:
        reason = (
            f"{radius_mm / (_RING_SIZE if ring else 1):.3g} mm covers fewer than 3 vertices of the surface"
        )
        raise UserError(f"fem.footprint_mm: {reason}; raise it, or anatomy.vertices")
    return np.asarray(kernel / total)


def find_anchors(gesture: Gesture, motion: ToolMotion, surface: Shape) -> tuple[Ints, Floats]:
    """Points where the two tips touch in each frame: (T, 2, 3) vertices of the surface and their weights.
    UserError: they are beyond the edge of the surface."""
    aside = gesture.sides
    start = np.asarray(gesture.point_mm) - 0.5 * np.asarray(gesture.path_mm)
    reach = np.abs(aside).max() + np.abs(motion.shift).max() + 3 * gesture.footprint_mm
    corner = surface.vertices[surface.faces, :2]
    close_faces = surface.faces[(np.abs(corner - start).max(axis=2) <= reach).any(axis=1)]
    places = (start + motion.shift)[:, None] + aside
    unique_places, place_index = np.unique(places.reshape(-1, 2), axis=0, return_inverse=True)
    contacts = [_find_under(place, surface.vertices, close_faces) for place in unique_places]
    shape = (*places.shape[:2], 3)
    corners, weights = (
        np.array(values)[place_index.ravel()].reshape(shape) for values in zip(*contacts, strict=True)
    )
    return corners, weights


def pose(gesture: Gesture, motion: ToolMotion, surface: Shape, positions: Floats) -> tuple[Floats, Floats]:
    """Tips (T, 2, 3) mm of the instrument, which rest on the tissue while they load it, and unit vectors (T,
    2, 3) from tip to hand; `surface` is at rest, its vertices go to `positions` (T, V, 3) mm. Raises as
    `find_anchors`."""
    corners, weights = find_anchors(gesture, motion, surface)
    frames = zip(weights, corners, positions, strict=True)
    contact_points = np.stack([np.einsum("kc,kcd->kd", w, vertices[c]) for w, c, vertices in frames])
    tips = contact_points + gesture.hover_mm * motion.away[:, None, None] * gesture.shaft
    return tips, np.broadcast_to(gesture.shaft, contact_points.shape).copy()


def _aside(spread_mm: float, azimuth_deg: float) -> Floats:
    """Vector (2,) mm from the middle of the tips to the second one."""
    across = np.radians(azimuth_deg + 90)
    return np.asarray(0.5 * spread_mm * np.array([np.cos(across), np.sin(across)]))


def _find_under(xy: Floats, vertices: Floats, faces: Array) -> tuple[Ints, Floats]:
    """The highest face above or below a point of the plane, and the point's barycentrics in it."""
    parts = side_areas(xy, vertices, faces)
    total = parts.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        bary = parts / total[:, None]
    hit = np.flatnonzero((np.abs(total) > 1e-12) & (bary >= -1e-9).all(axis=1))
    if len(hit) == 0:
        raise UserError("anatomy.craniotomy: the instrument touches beyond the edge of the surface")
    height = np.einsum("fc,fc->f", bary[hit], vertices[faces[hit], 2])
    best = hit[height.argmax()]
    return faces[best].astype(np.int64), bary[best]


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _smooth(s: Floats | float) -> Floats:
    """0 to 1 with level ends."""
    s = np.clip(s, 0, 1)
    return np.asarray(s * s * (3 - 2 * s))
