"""Instruments as meshes that follow tips and shafts: two forceps, dissector, suction, spatula, probe.

Sizes in mm are those of common neurosurgical instruments, chosen by eye, not from drawings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from synth.arrays import Floats, Indices, Map
from synth.errors import UserError
from synth.geometry.triangles import Shape, grid_faces, joined, lengths
from synth.render.appearance import reflection
from synth.render.appearance.reflection import Theatre

_AROUND = 40
RING = _AROUND + 1  # vertices of each of a part's rings
_LENGTH_MM = 110.0
_COAT_MM = 11.0  # from the tip
_CLIMB_MM, _REACH_MM = 0.30, 0.40  # height to which fluid climbs at a tip, and distance of its fall-off
_COATED = 0.4  # share of instruments whose end is coated black, against sticking and glare


@dataclass(frozen=True)
class Part:
    """A swept bar in its own axes: tip at the origin, z towards the hand, flat across x."""

    profile: Floats  # (V, 3) mm
    side: int  # tip of the instrument that it follows: 1, -1; 0: their middle


@dataclass(frozen=True)
class SteelInstruments:
    """All instruments of a scene as one mesh; see `content.Instruments`."""

    halves: tuple[float, ...]  # half the width of each one's contact with tissue, mm
    parts: tuple[tuple[Part, ...], ...]  # the parts of each, none where it is not drawn
    faces: Indices  # (F, 3) over all parts
    coat: Map  # (V,) 0 bare steel to 1 under a black coating
    theatre: Theatre  # that they mirror

    @property
    def tint(self) -> Floats:
        return reflection.tint(self.coat)

    @property
    def owner(self) -> Indices:
        sizes = [sum(len(part.profile) for part in one) for one in self.parts]
        return np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)[self.faces[:, 0]]

    def pose(self, tips: Floats, shafts: Floats) -> Shape:
        """The mesh with its tips (2n, 3) mm, two per instrument, else UserError; a single-tipped one is in
        their middle."""
        if len(tips) != 2 * len(self.parts):
            raise UserError(f"{len(tips)} tips for {len(self.parts)} instruments; give two for each")
        each = zip(self.parts, tips.reshape(-1, 2, 3), shafts.reshape(-1, 2, 3), strict=True)
        return Shape(np.concatenate([bar for one in each for bar in place(*one)]), self.faces)

    def glow(self, posed: Shape) -> Floats:
        return reflection.glow(posed, self.coat, self.theatre)

    def film(self, tips: Floats, surface: Floats) -> Floats:
        height = np.zeros(len(surface))
        for half, parts, ends in zip(self.halves, self.parts, tips.reshape(-1, 2, 3), strict=True):
            for end in ends if len(parts) == 2 else ends.mean(axis=0, keepdims=True)[: len(parts)]:
                away = lengths(surface - end) - half
                height = np.maximum(height, _CLIMB_MM * np.exp(-np.maximum(away, 0) / _REACH_MM))
        return height


def place(parts: Sequence[Part], ends: Floats, ways: Floats) -> list[Floats]:
    """Vertices (V, 3) mm of each part of an instrument with its tips and shafts (2, 3)."""
    placed = []
    for part in parts:
        # The flat sides of two tines face each other; a single blade's faces the tissue.
        if part.side == 0:
            tip, shaft, across = ends.mean(axis=0), ways.mean(axis=0), np.array([0.0, 0.0, 1.0])
        else:
            tip, shaft = (pair[0 if part.side == 1 else 1] for pair in (ends, ways))
            across = ends[1] - ends[0]
        placed.append(tip + part.profile @ _axes(shaft, across))
    return placed


def shape_of(kind: str, footprint_mm: float) -> tuple[tuple[Part, ...], float]:
    """Parts of an instrument for contacts of that radius a, and half the width [mm] of its tip."""
    if kind == "none":
        return (), 0.0
    make, share, least, most = SHAPES[kind]
    half = float(np.clip(share * footprint_mm, least, most))
    return make(half), half


def build(
    drawn: Sequence[tuple[str, float]], theatre: Theatre, rng: np.random.Generator
) -> SteelInstruments | None:
    """Instruments in a theatre, some of them with ends coated black; None if there is none.

    `drawn`: kind of each and the radius a of its contacts, mm.
    """
    coated = rng.random(len(drawn)) < _COATED
    parts, halves = zip(*(shape_of(*one) for one in drawn), strict=True) if drawn else ((), ())
    if not any(parts):
        return None
    bars, coat = [], []
    for own, ends in zip(parts, coated, strict=True):
        for part in own:
            bars.append(Shape(part.profile, grid_faces(len(part.profile) // RING, RING).reshape(-1, 3)))
            # The coating ends in a sharp ring.
            coat.append(ends / (1 + np.exp(np.clip((part.profile[:, 2] - _COAT_MM) / 0.12, -40, 40))))
    whole = np.concatenate(coat).astype(np.float32)
    return SteelInstruments(halves, parts, joined(*bars).faces, whole, theatre)


def _axes(shaft: Floats, across: Floats) -> Floats:
    """Rows x, y, z of an orthonormal frame: z along the shaft, x as near to `across` as possible."""
    z = shaft / np.linalg.norm(shaft)
    for level in (None, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]):
        side = across if level is None else np.cross(z, level)
        x = side - (side @ z) * z
        if np.linalg.norm(x) > 1e-9:
            x = x / np.linalg.norm(x)
            return np.stack([x, np.cross(z, x), z])
    raise ValueError("a shaft without direction")


def _sweep(s: Floats, thick: Floats, wide: Floats, bow: Floats, power: float) -> Floats:
    """Rings (V, 3) at z = `s`: half axes `thick` and `wide`, shifted by `bow` along x; round at power 1."""
    angle = np.linspace(0, 2 * np.pi, _AROUND + 1)
    c, w = np.cos(angle), np.sin(angle)
    x = np.sign(c) * np.abs(c) ** power
    y = np.sign(w) * np.abs(w) ** power
    columns = [thick[:, None] * x + bow[:, None], wide[:, None] * y, np.repeat(s[:, None], len(x), 1)]
    return np.stack(columns, -1).reshape(-1, 3)


def _along(rings: int) -> Floats:
    """Positions (rings,) mm of rings along an instrument, closer together at its tip."""
    return np.asarray((np.linspace(0, 1, rings) ** 1.6) * _LENGTH_MM)


def _round_off(s: Floats, over: float) -> Floats:
    """Factor that closes a bar's end as an ellipse does, over the first `over` mm."""
    return np.asarray(np.sqrt(np.clip(1 - (1 - np.minimum(s / over + 0.01, 1)) ** 2, 0, 1)))


def _forceps(half: float, aside_mm: float = 0.0) -> tuple[Part, ...]:
    """Two tines: a blunt tip that widens into a flat blade, bowed outwards (to -x for side 1), and the handle
    shifted by `aside_mm`, out of view."""
    s = _along(96)
    close = _round_off(s, 0.45)
    wide = (half - 0.03 + 0.9 * (1 - np.exp(-s / 9.0)) + 1.3 * (1 - np.exp(-s / 45.0))) * close
    thick = (0.34 + 0.42 * (1 - np.exp(-s / 8.0)) + 0.3 * (1 - np.exp(-s / 40.0))) * close
    bow = 5.5 * (1 - np.exp(-((s / 38.0) ** 1.5)))
    bend = np.clip((s - 24.0) / 14.0, 0, 1)
    shift = np.repeat(aside_mm * bend**2 * (3 - 2 * bend), _AROUND + 1)[:, None] * [0.0, 1.0, 0.0]
    return tuple(Part(_sweep(s, thick, wide, -side * bow, 0.7) + shift, side) for side in (1, -1))


def _dissector(half: float) -> tuple[Part, ...]:
    """A small rounded blade on a thin round shaft, slightly bent, that ends in a thicker handle."""
    s = _along(96)
    close = _round_off(s, 1.4)
    neck = np.exp(-((s / 5.0) ** 2))
    handle = 1.1 / (1 + np.exp(-(s - 42.0) / 2.0))
    thick = (0.28 + 0.55 * (1 - neck) + handle) * np.minimum(close * 1.4, 1)
    wide = (0.83 + (half - 0.75) * neck + handle) * close
    bow = 1.6 * np.exp(-s / 6.0) - 1.6
    return (Part(_sweep(s, thick, wide, bow, 0.9), 0),)


def _suction(half: float) -> tuple[Part, ...]:
    """A tube, open at its end, bent and wider towards the hand."""
    outside = 0.12 + _along(84)
    inside = np.array([8.0, 3.0, 1.0, 0.3, 0.05])
    s = np.concatenate([inside, outside])
    radius = half + np.concatenate([np.full(5, -0.15), 0.05 + 0.9 / (1 + np.exp(-(outside - 55.0) / 4.0))])
    radius[5] = half - 0.05  # a blunted edge
    bow = 2.5 * (1 - np.exp(-((s / 45.0) ** 2)))
    return (Part(_sweep(s, radius, radius, bow, 1.0), 0),)


def _spatula(half: float) -> tuple[Part, ...]:
    """A flat ribbon with a round end, bent where it leaves the wound."""
    s = _along(96)
    wide = (half + 0.8 * (1 - np.exp(-s / 30.0))) * _round_off(s, half)
    thick = np.full_like(s, 0.32) * _round_off(s, 0.3)
    bow = 4.0 * (1 - np.exp(-((s / 30.0) ** 2)))
    return (Part(_sweep(s, thick, wide, bow, 0.35), 0),)


def _probe(half: float) -> tuple[Part, ...]:
    """A ball on a thin shaft; at 50 degrees its lowest point is the tip."""
    s = _along(96)
    radius = np.maximum(np.sqrt(np.maximum(half**2 - (s - half) ** 2, 0)), np.where(s > half, 0.45 * half, 0))
    radius += 1.1 / (1 + np.exp(-(s - 42.0) / 2.0))
    low, up = (1 - np.sin(np.radians(50))) * half, np.cos(np.radians(50)) * half
    return (Part(_sweep(s - low, radius, radius, np.full_like(s, up), 1.0), 0),)


SHAPES: dict[str, tuple[Callable[[float], tuple[Part, ...]], float, float, float]] = {
    "forceps": (_forceps, 0.0, 0.45, 0.45),
    "bayonet": (partial(_forceps, aside_mm=13.0), 0.0, 0.45, 0.45),
    "dissector": (_dissector, 0.0, 1.5, 1.5),
    "suction": (_suction, 0.48, 1.0, 2.0),
    "spatula": (_spatula, 0.8, 1.5, 4.5),
    "probe": (_probe, 0.5, 0.6, 3.0),
}
"""Parts of each drawn kind by half the width of its tip: a share of the contact's radius, from and to mm."""
