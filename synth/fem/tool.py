"""The gesture: what the instrument does to the tissue, and where it is in every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.fem.material import Tissue
from synth.job import schema
from synth.job.instrument import CLEAR_MM, Instrument

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_PINCH = 0.5  # a grasp's tips press towards each other with this part of their pull
_FRICTION = 0.4  # a sliding tip drags with this part of its push
_RAMP = 0.25, 0.35  # time in which the load grows to its peak, as a part of the sequence


@dataclass(frozen=True)
class Contact:
    """One place where a tip loads the tissue."""

    point_mm: tuple[float, float]
    """World x, y of its centre at rest."""
    force_mn: tuple[float, float, float]
    """Force on the tissue at full load, world axes."""


@dataclass(frozen=True)
class Gesture:
    """What is drawn for the gesture of one sequence."""

    kind: str
    """`pull`, `push`, `slide`, `grasp`, `retract` or `tap`."""
    contacts: tuple[Contact, ...]
    """A grasp has two, the others one."""
    footprint_mm: float
    """Radius a of every contact."""
    load: float
    """Peak P = F/(E a^2) of a contact."""
    point_mm: tuple[float, float]
    """World x, y of the middle of the contacts at rest."""
    direction: tuple[float, float, float]
    """Unit vector in world axes: which way the tissue is loaded as a whole."""
    force_mn: float
    """Peak of the whole force."""
    path_mm: tuple[float, float]
    """World x, y that a slide covers; else 0."""
    azimuth_deg: float
    """Which side the hand is on, counter-clockwise from world x."""
    elevation_deg: float
    """Angle of the instrument above the surface."""
    spread_mm: float
    """Distance between the two tips."""
    hover_mm: float
    """How far the tips are from the tissue in the rest frame."""
    taps: int
    """How often the load comes and goes."""
    timing: tuple[float, float, float, float]
    """Parts of the sequence: touch, full load, load begins to fall, release."""

    @classmethod
    def draw(
        cls,
        fem: schema.Fem,
        craniotomy: schema.Craniotomy,
        tissue: Tissue,
        rng: np.random.Generator,
        asked: Instrument = Instrument(),
    ) -> Gesture:
        """Draws one gesture: contact uniformly in the opening, direction uniformly in its cone; or as asked.

        With `fem.within_mm` all that it loads keeps to that radius of the opening's middle.
        Where it is asked for a place, what is drawn may reach beyond the opening: see `fits`.

        Raises:
            UserError: what is drawn has no room in `fem.within_mm`.
        """
        drawn, want = str(rng.choice(fem.gestures)), fem.demand(asked)
        kind = asked.gesture or drawn
        footprint = float(rng.uniform(*want.footprint_mm))
        size = tissue.young_kpa * footprint**2
        given = want.load if want.force_mn is None else want.force_mn
        load = float(rng.uniform(*given)) / (1.0 if want.force_mn is None else size)
        spread = footprint * float(rng.uniform(1.2, 1.8) if kind == "grasp" else rng.uniform(0.1, 0.9))
        path = float(rng.uniform(3, 8)) if kind == "slide" else 0.0
        azimuth = float(rng.uniform(0, 360))
        reach = footprint + 0.5 * (path if kind == "slide" else spread if kind == "grasp" else 0.0)
        within = craniotomy.radius_mm if fem.within_mm is None else min(craniotomy.radius_mm, fem.within_mm)
        if within < min(reach + CLEAR_MM, craniotomy.radius_mm) and asked.place is None:
            raise UserError(
                f"fem.within_mm: a {kind} of {footprint:.3g} mm footprint reaches {reach:.3g} mm, which "
                f"{within:g} mm leave no room for; raise it or lower fem.footprint_mm"
            )
        room = max(within - reach - CLEAR_MM, 0.0)
        radius, angle = room * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        point = radius * np.array([np.cos(angle), np.sin(angle)])
        if asked.place is not None:
            point = np.asarray(asked.place, np.float64)
        turn = rng.uniform(0, 2 * np.pi)
        along = np.array([np.cos(turn), np.sin(turn)])
        cone = np.cos(np.radians(fem.cone_deg))
        rise = rng.uniform(cone, 1.0)
        if kind == "retract":  # sideways, as a spatula holds tissue away
            rise = rng.uniform(0.1, max(cone, 0.3))
        elif kind == "slide":
            rise = 1 / np.hypot(1, _FRICTION)
        if asked.direction is not None:
            whole = np.asarray(asked.direction) / np.linalg.norm(asked.direction)
            along = whole[:2] / (np.hypot(*whole[:2]) or 1.0)
            rise = rise if kind == "slide" else abs(float(whole[2]))
        up = rise if kind in ("pull", "grasp") else -rise
        way = np.append(np.sqrt(1 - rise**2) * along, up)
        across = np.radians(azimuth + 90)
        aside = 0.5 * spread * np.array([np.cos(across), np.sin(across)])
        places, ways = [point - 0.5 * path * along], [way]
        if kind == "grasp":
            places, ways = [point - aside, point + aside], []
            for inward in (aside, -aside):
                pinched = way + _PINCH * np.append(inward, 0) / np.linalg.norm(inward)
                ways.append(pinched / np.linalg.norm(pinched))
        force = load * size
        whole = force * np.sum(ways, axis=0)
        touch = float(rng.uniform(0.08, 0.15))
        full = touch + float(rng.uniform(*((0.1, 0.2) if kind == "tap" else _RAMP)))
        release = float(rng.uniform(0.85, 0.92))
        hold = float(rng.uniform(0.5, 0.7) if kind in ("retract", "slide") else rng.uniform(0.15, 0.5))
        timing = (touch, full, full + hold * (release - full), release)
        return cls(
            kind=kind,
            contacts=tuple(
                Contact((float(p[0]), float(p[1])), _vector(f))
                for p, f in zip(places, force * np.array(ways), strict=True)
            ),
            footprint_mm=footprint,
            load=load,
            point_mm=(float(point[0]), float(point[1])),
            direction=_vector(whole / np.linalg.norm(whole)),
            force_mn=float(np.linalg.norm(whole)),
            path_mm=(float(path * along[0]), float(path * along[1])),
            azimuth_deg=azimuth,
            elevation_deg=float(rng.uniform(35, 65)),
            spread_mm=spread,
            hover_mm=float(rng.uniform(6, 12)),
            taps=int(rng.integers(2, 4)) if kind == "tap" else 1,
            timing=asked.timing or timing,
        )


@dataclass(frozen=True)
class Course:
    """The gesture over T frames. In frame 0 there is no load and the tips are whole `hover_mm` away."""

    load: Floats
    """(T,) as a part of the peak."""
    away: Floats
    """(T,) distance of the tips from the tissue, as a part of `hover_mm`."""
    shift: Floats
    """(T, 2) mm that the contacts have slid over the surface at rest."""


def course(gesture: Gesture, frames: int) -> Course:
    """When the load comes and goes, and where to."""
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
    return Course(load, np.maximum(away, lifted * (load < 1e-3)), slid[:, None] * np.asarray(gesture.path_mm))


def focus(gesture: Gesture) -> tuple[tuple[float, float, float], ...]:
    """Where the mesh should be finest: x, y and radius of what is loaded, mm."""
    stops = (0.0, 0.5, 1.0) if any(gesture.path_mm) else (0.0,)
    return tuple(
        (c.point_mm[0] + s * gesture.path_mm[0], c.point_mm[1] + s * gesture.path_mm[1], gesture.footprint_mm)
        for c in gesture.contacts
        for s in stops
    )


def tractions(gesture: Gesture, over: Course, vertices: Floats, area: Floats) -> Floats:
    """Load on the surface at rest.

    Args:
        gesture: contacts and forces.
        over: its course.
        vertices: (V, 3) mm at rest.
        area: (V,) mm^2.

    Returns:
        (T, V, 3) kPa, with sum(area * result) = the force.

    Raises:
        UserError: fewer than 3 vertices lie under a contact.
    """
    out = np.zeros((len(over.load), len(vertices), 3))
    for contact in gesture.contacts:
        start = np.asarray(contact.point_mm)
        kernel = footprint(start, gesture.footprint_mm, vertices, area)
        for t, part in enumerate(over.load):
            if part > 0:
                if over.shift[t].any():
                    kernel = footprint(start + over.shift[t], gesture.footprint_mm, vertices, area)
                out[t] += np.outer(part * kernel, contact.force_mn)
    return out


def footprint(centre: Floats, radius_mm: float, vertices: Floats, area: Floats) -> Floats:
    """Pressure of a unit force: the kernel (1 - (r/a)^2)^2 on the surface at rest.

    Args:
        centre: (2,) world x, y, mm.
        radius_mm: a.
        vertices: (V, 3) mm at rest.
        area: (V,) mm^2.

    Returns:
        (V,) 1/mm^2, with sum(area * result) = 1.

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


def anchors(
    gesture: Gesture, over: Course, vertices: Floats, faces: NDArray[np.integer]
) -> tuple[Ints, Floats]:
    """Where the tips touch: (T, K, 3) vertices of the surface and their weights (T, K, 3)."""
    across = np.radians(gesture.azimuth_deg + 90)
    aside = 0.5 * gesture.spread_mm * np.array([np.cos(across), np.sin(across)])
    start = np.asarray(gesture.point_mm) - 0.5 * np.asarray(gesture.path_mm)
    reach = np.abs(aside).max() + np.abs(gesture.path_mm).max() + 3 * gesture.footprint_mm
    near = faces[(np.abs(vertices[faces, :2] - start).max(axis=2) <= reach).any(axis=1)]
    found: dict[tuple[float, ...], tuple[Ints, Floats]] = {}
    for shift in over.shift:
        for side in (-1, 1):
            place = tuple(start + shift + side * aside)
            if place not in found:
                found[place] = _under(np.asarray(place), vertices, near)
    touched = [[found[tuple(start + s + side * aside)] for side in (-1, 1)] for s in over.shift]
    return np.array([[p[0] for p in pair] for pair in touched]), np.array(
        [[p[1] for p in pair] for pair in touched]
    )


def pose(
    gesture: Gesture, over: Course, vertices: Floats, faces: NDArray[np.integer], surface: Floats
) -> tuple[Floats, Floats]:
    """Where the instrument is: its tips rest on the tissue while they load it.

    Args:
        gesture, over: what it does.
        vertices: (V, 3) mm at rest.
        faces: (F, 3).
        surface: (T, V, 3) mm, the moved vertices.

    Returns:
        Tips (T, 2, 3) mm and unit vectors from tip to hand (T, 2, 3).

    Raises:
        UserError: it touches beyond the edge of the surface.
    """
    corners, weights = anchors(gesture, over, vertices, faces)
    touched = np.stack(
        [np.einsum("kc,kcd->kd", w, at[c]) for w, c, at in zip(weights, corners, surface, strict=True)]
    )
    tips = touched + gesture.hover_mm * over.away[:, None, None] * shaft(gesture)
    return tips, np.broadcast_to(shaft(gesture), touched.shape).copy()


def shaft(gesture: Gesture) -> Floats:
    """Unit vector from the tips to the hand, (3,) world axes."""
    turn, up = np.radians(gesture.azimuth_deg), np.radians(gesture.elevation_deg)
    return np.array([np.cos(turn) * np.cos(up), np.sin(turn) * np.cos(up), np.sin(up)])


def _under(xy: Floats, vertices: Floats, faces: NDArray[np.integer]) -> tuple[Ints, Floats]:
    """The highest face above or below a point of the plane, and the point's barycentrics in it."""
    a, b, c = (vertices[faces[:, i], :2] - xy for i in range(3))
    parts = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
    whole = parts.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        bary = parts / whole[:, None]
    hit = np.flatnonzero((np.abs(whole) > 1e-12) & (bary >= -1e-9).all(axis=1))
    if len(hit) == 0:
        raise UserError("anatomy.craniotomy: the instrument touches beyond the edge of the surface")
    height = np.einsum("fc,fc->f", bary[hit], vertices[faces[hit], 2])
    best = hit[height.argmax()]
    return faces[best].astype(np.int64), bary[best]


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _vector(value: Floats) -> tuple[float, float, float]:
    return float(value[0]), float(value[1]), float(value[2])


def _smooth(s: Floats) -> Floats:
    """0 to 1 with level ends."""
    s = np.clip(s, 0, 1)
    return np.asarray(s * s * (3 - 2 * s))
