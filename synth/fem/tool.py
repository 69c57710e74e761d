"""The gesture: what the instrument does to the tissue, and where it is in every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth import job
from synth.errors import UserError
from synth.fem.material import Tissue

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_INSIDE_MM = 1.0  # clear of the rim


@dataclass(frozen=True)
class Gesture:
    """What is drawn for the gesture of one sequence."""

    kind: str
    """`pull` or `push`."""
    point_mm: tuple[float, float]
    """World x, y of the contact's centre at rest."""
    direction: tuple[float, float, float]
    """Unit vector in world axes: which way the tissue is loaded."""
    load: float
    """Peak P = F/(E a^2)."""
    footprint_mm: float
    """Radius a of the contact."""
    force_mn: float
    """Peak force F."""
    azimuth_deg: float
    """Which side the hand is on, counter-clockwise from world x."""
    elevation_deg: float
    """Angle of the instrument above the surface."""
    spread_mm: float
    """Distance between the two tips."""
    hover_mm: float
    """How far the tips are from the tissue in the rest frame."""
    timing: tuple[float, float, float, float]
    """Parts of the sequence: touch, full load, load begins to fall, release."""

    @classmethod
    def draw(
        cls, fem: job.Fem, craniotomy: job.Craniotomy, tissue: Tissue, rng: np.random.Generator
    ) -> Gesture:
        """Draws one gesture: contact uniformly in the opening, direction uniformly in its cone."""
        kind = str(rng.choice(fem.gestures))
        footprint = float(rng.uniform(*fem.footprint_mm))
        load = float(rng.uniform(*fem.load))
        room = max(craniotomy.radius_mm - footprint - _INSIDE_MM, 0.0)
        radius, angle = room * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        rise = rng.uniform(np.cos(np.radians(fem.cone_deg)), 1.0)
        turn, flat = rng.uniform(0, 2 * np.pi), np.sqrt(1 - rise**2)
        touch = rng.uniform(0.08, 0.15)
        full = touch + rng.uniform(0.3, 0.4)
        fall = full + rng.uniform(0.1, 0.2)
        return cls(
            kind=kind,
            point_mm=(float(radius * np.cos(angle)), float(radius * np.sin(angle))),
            direction=(
                float(flat * np.cos(turn)),
                float(flat * np.sin(turn)),
                float(rise if kind == "pull" else -rise),
            ),
            load=load,
            footprint_mm=footprint,
            force_mn=load * tissue.young_kpa * footprint**2,
            azimuth_deg=float(rng.uniform(0, 360)),
            elevation_deg=float(rng.uniform(35, 65)),
            spread_mm=float(footprint * (rng.uniform(0.5, 0.9) if kind == "pull" else rng.uniform(0.1, 0.2))),
            hover_mm=float(rng.uniform(6, 12)),
            timing=(float(touch), float(full), float(fall), float(fall + rng.uniform(0.15, 0.25))),
        )


def course(gesture: Gesture, frames: int) -> tuple[Floats, Floats]:
    """The gesture over time.

    Returns:
        (T,) load over its peak, and (T,) distance of the tips from the tissue over `hover_mm`.
        In frame 0 the load is none and the distance whole.
    """
    t = np.linspace(0, 1, frames)
    touch, full, fall, leave = gesture.timing
    load = _smooth((t - touch) / (full - touch)) * (1 - _smooth((t - fall) / (leave - fall)))
    away = 1 - _smooth(t / touch) + _smooth((t - leave) / max(1 - leave, 1e-9))
    return load, away


def focus(gesture: Gesture) -> tuple[tuple[float, float, float], ...]:
    """Where the mesh should be finest: x, y and radius of what is loaded, mm."""
    return ((*gesture.point_mm, gesture.footprint_mm),)


def footprint(gesture: Gesture, vertices: Floats, area: Floats) -> Floats:
    """Pressure of a unit force: the kernel (1 - (r/a)^2)^2 on the surface at rest.

    Args:
        gesture: point and radius are used.
        vertices: (V, 3) mm at rest.
        area: (V,) mm^2.

    Returns:
        (V,) 1/mm^2, with sum(area * result) = 1.

    Raises:
        UserError: no vertex lies under the contact.
    """
    top = np.asarray(gesture.point_mm)
    flat = np.hypot(*(vertices[:, :2] - top).T)
    centre = np.append(top, vertices[flat.argmin(), 2])
    reach = np.minimum(np.linalg.norm(vertices - centre, axis=1) / gesture.footprint_mm, 1)
    kernel = (1 - reach**2) ** 2
    total = float(kernel @ area)
    if np.count_nonzero(kernel) < 3 or total <= 0:
        raise UserError(
            f"fem.footprint_mm: {gesture.footprint_mm:g} mm covers fewer than 3 vertices of the surface; "
            "raise it, or anatomy.vertices"
        )
    return np.asarray(kernel / total)


def anchors(gesture: Gesture, vertices: Floats, faces: NDArray[np.integer]) -> tuple[Ints, Floats]:
    """Where the tips touch: (K, 3) vertices of the surface and their weights (K, 3)."""
    turn = np.radians(gesture.azimuth_deg + 90)
    aside = 0.5 * gesture.spread_mm * np.array([np.cos(turn), np.sin(turn)])
    places = [_under(np.asarray(gesture.point_mm) + side * aside, vertices, faces) for side in (-1, 1)]
    return np.stack([p[0] for p in places]), np.stack([p[1] for p in places])


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


def _smooth(s: Floats) -> Floats:
    """0 to 1 with level ends."""
    s = np.clip(s, 0, 1)
    return np.asarray(s * s * (3 - 2 * s))
