"""Gestures: the load of an instrument on the tissue, and its pose in every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.arrays import Array, Floats, Ints
from synth.errors import UserError
from synth.geometry.triangles import Shape, side_areas

_PINCH = 0.5  # force of a grasp's tips towards each other, as a part of their pull
FRICTION = 0.4  # drag of a sliding tip, as a part of its push
_OVERLAP = 0.6  # least distance of contacts over their radii's sum: together they peak at 1.1 of one's peak
_BLADE_MM, _SPREADING, _BODY_MM = 3.0, 0.3, 14.0  # clearance at a tip, its growth up the shaft, its largest
_LENGTH_MM, _STEPS = 110.0, 23


@dataclass(frozen=True)
class ToolContact:
    """One place where a tip loads the tissue."""

    point_mm: tuple[float, float]  # world x, y of its centre at rest
    force_mn: tuple[float, float, float]  # force on the tissue at full load, world axes


@dataclass(frozen=True)
class Gesture:
    """Gesture of one instrument in a sequence."""

    kind: str  # `pull`, `push`, `slide`, `grasp`, `retract` or `tap`
    contacts: tuple[ToolContact, ...]  # A grasp has two, the others one
    footprint_mm: float  # radius a of every contact
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

    @property
    def reach_mm(self) -> float:
        """Largest distance of loaded tissue from the opening's middle."""
        start = np.array([c.point_mm for c in self.contacts])
        ends = np.concatenate([start, start + np.asarray(self.path_mm)])
        return float(np.hypot(*ends.T).max()) + self.footprint_mm

    @property
    def focus(self) -> tuple[tuple[float, float, float], ...]:
        """Places where the mesh should be finest: x, y and radius of the contacts, mm."""
        stops = (0.0, 0.5, 1.0) if any(self.path_mm) else (0.0,)
        (dx, dy), radius = self.path_mm, self.footprint_mm
        places = [(contact.point_mm, s) for contact in self.contacts for s in stops]
        return tuple((x + s * dx, y + s * dy, radius) for (x, y), s in places)

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


def grip(
    kind: str, point: Floats, direction: Floats, spread_mm: float, azimuth_deg: float
) -> tuple[Floats, Floats]:
    """Centres (C, 2) mm and load directions (C, 3), unit vectors, of an instrument's tips: one, or two of a
    grasp.

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


def clearance(one: Gesture, other: Gesture) -> float:
    """Distance of two gestures' contacts and shafts beyond the clearance they need, mm."""
    here, there = np.array(one.focus), np.array(other.focus)
    apart = np.linalg.norm(here[:, None, :2] - there[None, :, :2], axis=2)
    contacts = (apart - _OVERLAP * (here[:, None, 2] + there[None, :, 2])).min()
    s = np.linspace(0, _LENGTH_MM, _STEPS)
    lines = [np.append(g.point_mm, 0.0) + s[:, None] * g.shaft for g in (one, other)]
    gap = np.linalg.norm(lines[0][:, None] - lines[1][None], axis=2)
    wide = np.minimum(_BLADE_MM + _SPREADING * np.maximum(s[:, None], s[None, :]), _BODY_MM)
    return float(min(contacts, (gap - wide).min()))


def trajectory(gesture: Gesture, frames: int) -> ToolMotion:
    """The gesture's own motion over T frames."""
    t = np.linspace(0, 1, frames)
    touch, full, fall, leave = gesture.timing
    if gesture.taps > 1:
        phase = np.clip((t - touch) / (leave - touch), 0, 1) * gesture.taps
        load = np.sin(np.pi * (phase % 1)) ** 2 * ((t > touch) & (t < leave))
        lifted = 0.15 * np.cos(np.pi * (phase % 1)) ** 2
    else:
        load = _smooth((t - touch) / (full - touch)) * (1 - _smooth((t - fall) / (leave - fall)))
        lifted = np.zeros(frames)
    away = 1 - _smooth(t / touch) + _smooth((t - leave) / (1 - leave))
    slid = _smooth((t - full) / max(fall - full, 1e-9))
    # The rest frame is the first one, whatever the timing.
    load[0] = 0.0
    shift = slid[:, None] * np.asarray(gesture.path_mm)
    return ToolMotion(load, np.maximum(away, lifted * (load < 1e-3)), shift)


def tractions(gesture: Gesture, motion: ToolMotion, vertices: Floats, area: Floats) -> Floats:
    """Load (T, V, 3) kPa on the surface at rest, (V, 3) mm: sum(area * result) is the force; `area`: (V,)
    mm^2.

    Raises UserError as `footprint`.
    """
    out = np.zeros((len(motion.load), len(vertices), 3))
    for contact in gesture.contacts:
        start = np.asarray(contact.point_mm)
        kernel = footprint(start, gesture.footprint_mm, vertices, area)
        for t, part in enumerate(motion.load):
            if part > 0:
                if motion.shift[t].any():
                    kernel = footprint(start + motion.shift[t], gesture.footprint_mm, vertices, area)
                out[t] += np.outer(part * kernel, contact.force_mn)
    return out


def footprint(centre: Floats, radius_mm: float, vertices: Floats, area: Floats) -> Floats:
    """Pressure (V,) 1/mm^2 of a unit force: the kernel (1 - (r/a)^2)^2 on the surface, sum(area * result) =
    1.

    Args:
        centre: (2,) world x, y, mm.
        radius_mm: a.
        vertices, area: (V, 3) mm at rest, and (V,) mm^2.

    Raises:
        UserError: fewer than 3 vertices lie under the contact.
    """
    flat = np.hypot(*(vertices[:, :2] - centre).T)
    middle = np.append(centre, vertices[flat.argmin(), 2])
    reach = np.minimum(np.linalg.norm(vertices - middle, axis=1) / radius_mm, 1)
    kernel = (1 - reach**2) ** 2
    total = float(kernel @ area)
    if np.count_nonzero(kernel) < 3 or total <= 0:
        raise UserError(
            f"fem.footprint_mm: {radius_mm:g} mm covers fewer than 3 vertices of the surface; "
            "raise it, or anatomy.vertices"
        )
    return np.asarray(kernel / total)


def anchors(gesture: Gesture, motion: ToolMotion, surface: Shape) -> tuple[Ints, Floats]:
    """Points where the two tips touch in each frame: (T, 2, 3) vertices of the surface and their weights.

    Raises UserError beyond the edge of the surface.
    """
    aside = _aside(gesture.spread_mm, gesture.azimuth_deg)
    start = np.asarray(gesture.point_mm) - 0.5 * np.asarray(gesture.path_mm)
    reach = np.abs(aside).max() + np.abs(motion.shift).max() + 3 * gesture.footprint_mm
    corner = surface.vertices[surface.faces, :2]
    near = surface.faces[(np.abs(corner - start).max(axis=2) <= reach).any(axis=1)]
    places = (start + motion.shift)[:, None] + np.stack([-aside, aside])
    once, which = np.unique(places.reshape(-1, 2), axis=0, return_inverse=True)
    found = [_under(place, surface.vertices, near) for place in once]
    shape = (*places.shape[:2], 3)
    corners, weights = (np.array(of)[which.ravel()].reshape(shape) for of in zip(*found, strict=True))
    return corners, weights


def pose(gesture: Gesture, motion: ToolMotion, surface: Shape, moved: Floats) -> tuple[Floats, Floats]:
    """Tips (T, 2, 3) mm of the instrument, which rest on the tissue while they load it, and unit vectors (T,
    2, 3) from tip to hand.

    `surface` is at rest; `moved` (T, V, 3) mm are its vertices over time. Raises UserError as `anchors`.
    """
    corners, weights = anchors(gesture, motion, surface)
    touched = np.stack(
        [np.einsum("kc,kcd->kd", w, at[c]) for w, c, at in zip(weights, corners, moved, strict=True)]
    )
    tips = touched + gesture.hover_mm * motion.away[:, None, None] * gesture.shaft
    return tips, np.broadcast_to(gesture.shaft, touched.shape).copy()


def _aside(spread_mm: float, azimuth_deg: float) -> Floats:
    """Vector (2,) mm from the middle of the tips to the second one."""
    across = np.radians(azimuth_deg + 90)
    return np.asarray(0.5 * spread_mm * np.array([np.cos(across), np.sin(across)]))


def _under(xy: Floats, vertices: Floats, faces: Array) -> tuple[Ints, Floats]:
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


def _smooth(s: Floats) -> Floats:
    """0 to 1 with level ends."""
    s = np.clip(s, 0, 1)
    return np.asarray(s * s * (3 - 2 * s))
