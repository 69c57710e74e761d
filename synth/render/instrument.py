"""Instruments as meshes that follow tips and shafts: forceps of two kinds, dissector, suction, spatula.

Sizes in mm are those of common neurosurgical instruments, chosen by eye, not from drawings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from synth.arrays import Floats, Indices, Map
from synth.errors import UserError
from synth.geometry.triangles import Shape, grid_faces, joined, lengths
from synth.render.appearance import reflection
from synth.render.appearance.reflection import Theatre

Kind = Literal["forceps", "bayonet", "dissector", "suction", "spatula"]

_AROUND = 40
_LENGTH_MM = 110.0
_COAT_MM = 11.0  # from the tip

_CLIMB_MM, _REACH_MM = 0.30, 0.40  # height to which fluid climbs at a tip, and distance of its fall-off

# Instruments that suit each gesture, and their shares.
_HABITS: dict[str, tuple[tuple[Kind, ...], tuple[float, ...]]] = {
    "pull": (("forceps", "bayonet"), (0.5, 0.5)),
    "grasp": (("forceps", "bayonet"), (0.5, 0.5)),
    "push": (("dissector", "suction"), (0.6, 0.4)),
    "slide": (("dissector", "suction"), (0.5, 0.5)),
    "tap": (("dissector", "suction"), (0.7, 0.3)),
    "retract": (("spatula", "dissector"), (0.7, 0.3)),
}
_COATED = 0.4  # share of instruments whose end is coated black, against sticking and glare


@dataclass(frozen=True)
class Part:
    """A swept bar in its own axes: tip at the origin, z towards the hand, flat across x."""

    profile: Floats  # (V, 3) mm
    side: int  # tip of the instrument that it follows: 1, -1; 0: their middle


@dataclass(frozen=True)
class SteelInstruments:
    """All instruments of a scene as one mesh; see `content.Instruments`."""

    kinds: tuple[Kind, ...]
    parts: tuple[tuple[Part, ...], ...]  # the parts of each
    faces: Indices  # (F, 3) over all parts
    coat: Map  # (V,) 0 bare steel to 1 under a black coating
    theatre: Theatre  # that they mirror

    @property
    def tint(self) -> Floats:
        return reflection.tint(self.coat)

    def pose(self, tips: Floats, shafts: Floats) -> Shape:
        """The mesh with its tips (2n, 3) mm, two per instrument; a single-tipped one is in their middle.

        Raises:
            UserError: the number of tips is not two per instrument.
        """
        if len(tips) != 2 * len(self.parts):
            raise UserError(f"{len(tips)} tips for {len(self.parts)} instruments; give two for each")
        placed = []
        for k, parts in enumerate(self.parts):
            ends, ways = tips[2 * k : 2 * k + 2], shafts[2 * k : 2 * k + 2]
            for part in parts:
                # The flat sides of two tines face each other; a single blade's faces the tissue.
                if part.side == 0:
                    tip, shaft, across = ends.mean(axis=0), ways.mean(axis=0), np.array([0.0, 0.0, 1.0])
                else:
                    tip, shaft = (pair[0 if part.side == 1 else 1] for pair in (ends, ways))
                    across = ends[1] - ends[0]
                placed.append(tip + part.profile @ _axes(shaft, across))
        return Shape(np.concatenate(placed), self.faces)

    def glow(self, posed: Shape) -> Floats:
        return reflection.glow(posed, self.coat, self.theatre)

    def film(self, tips: Floats, surface: Floats) -> Floats:
        height = np.zeros(len(surface))
        for k, kind in enumerate(self.kinds):
            ends = tips[2 * k : 2 * k + 2]
            for end in ends if len(self.parts[k]) == 2 else ends.mean(axis=0, keepdims=True):
                away = lengths(surface - end) - _SHAPES[kind][1]
                height = np.maximum(height, _CLIMB_MM * np.exp(-np.maximum(away, 0) / _REACH_MM))
        return height


def choose(gestures: Sequence[str], rng: np.random.Generator) -> tuple[Kind, ...]:
    """An instrument that suits each gesture."""
    suitable = (_HABITS[gesture] for gesture in gestures)
    return tuple(kinds[int(rng.choice(len(kinds), p=shares))] for kinds, shares in suitable)


def build(kinds: Sequence[Kind], theatre: Theatre, rng: np.random.Generator) -> SteelInstruments:
    """One or more instruments in a theatre, some of them with ends coated black."""
    coated = rng.random(len(kinds)) < _COATED
    parts = tuple(_SHAPES[kind][0]() for kind in kinds)
    bars, coat = [], []
    for own, ends in zip(parts, coated, strict=True):
        for part in own:
            rings = len(part.profile) // (_AROUND + 1)
            bars.append(Shape(part.profile, grid_faces(rings, _AROUND + 1).reshape(-1, 3)))
            # The coating ends in a sharp ring.
            coat.append(ends / (1 + np.exp(np.clip((part.profile[:, 2] - _COAT_MM) / 0.12, -40, 40))))
    return SteelInstruments(
        tuple(kinds), parts, joined(*bars).faces, np.concatenate(coat).astype(np.float32), theatre
    )


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


def _forceps(aside_mm: float = 0.0) -> tuple[Part, ...]:
    """Two tines: a blunt tip that widens into a flat blade, bowed outwards (to -x for side 1).

    `aside_mm`: shift of the handle, which a bayonet's two bends move out of view.
    """
    s = _along(96)
    close = _round_off(s, 0.45)
    wide = (0.42 + 0.9 * (1 - np.exp(-s / 9.0)) + 1.3 * (1 - np.exp(-s / 45.0))) * close
    thick = (0.34 + 0.42 * (1 - np.exp(-s / 8.0)) + 0.3 * (1 - np.exp(-s / 40.0))) * close
    bow = 5.5 * (1 - np.exp(-((s / 38.0) ** 1.5)))
    bend = np.clip((s - 24.0) / 14.0, 0, 1)
    shift = np.repeat(aside_mm * bend**2 * (3 - 2 * bend), _AROUND + 1)[:, None] * [0.0, 1.0, 0.0]
    return tuple(Part(_sweep(s, thick, wide, -side * bow, 0.7) + shift, side) for side in (1, -1))


def _dissector() -> tuple[Part, ...]:
    """A small rounded blade on a thin round shaft, slightly bent, that ends in a thicker handle."""
    s = _along(96)
    close = _round_off(s, 1.4)
    neck = np.exp(-((s / 5.0) ** 2))
    handle = 1.1 / (1 + np.exp(-(s - 42.0) / 2.0))
    thick = (0.28 + 0.55 * (1 - neck) + handle) * np.minimum(close * 1.4, 1)
    wide = (0.83 + 0.75 * neck + handle) * close
    bow = 1.6 * np.exp(-s / 6.0) - 1.6
    return (Part(_sweep(s, thick, wide, bow, 0.9), 0),)


def _suction() -> tuple[Part, ...]:
    """A tube, open at its end, bent and wider towards the hand."""
    outside = 0.12 + _along(84)
    inside = np.array([8.0, 3.0, 1.0, 0.3, 0.05])
    s = np.concatenate([inside, outside])
    radius = np.concatenate([np.full(5, 1.05), 1.25 + 0.9 / (1 + np.exp(-(outside - 55.0) / 4.0))])
    radius[5] = 1.15  # a blunted edge
    bow = 2.5 * (1 - np.exp(-((s / 45.0) ** 2)))
    return (Part(_sweep(s, radius, radius, bow, 1.0), 0),)


def _spatula() -> tuple[Part, ...]:
    """A flat ribbon with a round end, bent where it leaves the wound."""
    s = _along(96)
    wide = (3.4 + 0.8 * (1 - np.exp(-s / 30.0))) * _round_off(s, 3.4)
    thick = np.full_like(s, 0.32) * _round_off(s, 0.3)
    bow = 4.0 * (1 - np.exp(-((s / 30.0) ** 2)))
    return (Part(_sweep(s, thick, wide, bow, 0.35), 0),)


_SHAPES: dict[Kind, tuple[Callable[[], tuple[Part, ...]], float]] = {
    "forceps": (_forceps, 0.45),
    "bayonet": (partial(_forceps, 13.0), 0.45),
    "dissector": (_dissector, 1.5),
    "suction": (_suction, 1.2),
    "spatula": (_spatula, 3.0),
}
"""Parts of each kind, and half the width [mm] of its contact with tissue."""
