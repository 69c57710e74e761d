"""Instruments as meshes that follow tips and shafts: forceps, dissector, suction, rods, fingers, cloth.

Sizes in mm are those of common neurosurgical instruments, chosen by eye, not from drawings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from types import MappingProxyType

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from synth.arrays import Floats, Indices, Map
from synth.errors import UserError
from synth.geometry.triangles import Shape, grid_faces, join_shapes
from synth.render import finish, finish_maps
from synth.render.appearance import reflection
from synth.render.appearance.reflection import Theatre
from synth.render.finish import Finish
from synth.render.finish_maps import RING
from synth.render.idle import CLOTH, IdleInstrument
from synth.render.materials import FinishMaps, read_map, stack_maps

_RINGS = 64
_LENGTH_MM = 110.0
_CLIMB_MM, _REACH_MM = 0.55, 0.35  # height to which fluid climbs at a tip, and distance of its fall-off
_TOUCH_MM = 0.15  # distance from an instrument's vertices at which its surface is
_SHADE, _SHADE_MM = 0.6, 1.1  # light that a body takes where it touches, and distance of its fall-off
_AWAY_MM = 2.5  # distance from which on neither is seen
_OTHER_SIZES = 0.6, 1.6  # of an acting instrument's tip, at strength 1
_SHEET_MM, _LAID_MM = 0.4, 0.45  # spacing of a cloth's vertices, its height over what is below


@dataclass(frozen=True)
class Part:
    """A swept bar in its own axes: tip at the origin, z towards the hand, flat across x."""

    profile: Floats  # (V, 3) mm
    side: int  # tip of the instrument that it follows: 1, -1; 0: their middle
    rows: int = 0  # of a sheet of cloth; 0: closed rings
    faces: Indices | None = None  # of a mesh without rings; None: a grid's
    outline: Floats | None = None  # (R * RING, 3) mm of such a mesh: rings around it, which have its texture

    @property
    def shape(self) -> Shape:
        if self.faces is not None:
            return Shape(self.profile, self.faces)
        rows = self.rows or len(self.profile) // RING
        faces = grid_faces(rows, len(self.profile) // rows, "" if self.rows else "columns")
        return Shape(self.profile, faces.reshape(-1, 3))

    @property
    def uv(self) -> Map:
        """(V, 2) place in its maps, see `finish_maps`."""
        if self.outline is not None:
            return finish_maps.wrap(self.profile, self.outline)
        if not self.rows:
            return finish_maps.unfold(self.profile, self.turn)
        sizes = self.rows, len(self.profile) // self.rows
        ends = [np.linspace(0, 1, size, dtype=np.float32) for size in sizes]
        across, along = np.meshgrid(*ends, indexing="ij")
        return np.column_stack([along.ravel(), across.ravel()])

    @property
    def turn(self) -> int:
        """Column of its rings that faces the microscope: of a tine its edge, of a blade its flat side."""
        return RING // 4 if self.side else 0

    def maps(self, skin: Finish, kind: str, rng: np.random.Generator, mm_per_px: float) -> FinishMaps:
        """Its texture in a finish."""
        rings = self.profile if self.outline is None else self.outline
        return finish_maps.paint(skin, rings, self.rows, self.turn, kind, rng, mm_per_px)

    def resize(self, size: float) -> Part:
        """The part, larger by a factor."""
        outline = None if self.outline is None else size * self.outline
        return replace(self, profile=size * self.profile, outline=outline)


@dataclass(frozen=True, eq=False)
class OwnMesh:
    """An instrument of one's own; see `instrument_file`."""

    part: Part
    half: float  # half the width of its tip, mm

    @property
    def outline(self) -> Part:
        """Rings around it, for its distance from other instruments."""
        assert self.part.outline is not None
        return Part(self.part.outline, 0)


NO_MESHES: Mapping[str, OwnMesh] = MappingProxyType({})


@dataclass(frozen=True)
class InstrumentMesh:
    """All instruments of a scene as one mesh; see `content.Instruments`."""

    parts: tuple[tuple[Part, ...], ...]  # the parts of each, none where it is not drawn
    faces: Indices  # (F, 3) over all parts
    uv: Map  # (V, 2)
    maps: FinishMaps
    theatre: Theatre  # that they mirror

    @cached_property
    def alpha(self) -> Floats:
        """(V,) roughness at the vertices, for what they mirror."""
        texels = np.sqrt(self.maps.rough[..., 0] * self.maps.rough[..., 1])
        return read_map(texels, self.uv).astype(np.float64)

    @cached_property
    def bare(self) -> Floats:
        """(V,) share of bare metal at the vertices."""
        return read_map(self.maps.bare, self.uv).astype(np.float64)

    @property
    def owner(self) -> Indices:
        sizes = [sum(len(part.profile) for part in parts) for parts in self.parts]
        return np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)[self.faces[:, 0]]

    def pose(self, tips: Floats, shafts: Floats) -> Shape:
        """The mesh with its tips (2n, 3) mm, two per instrument, else UserError; a single-tipped one is in
        their middle."""
        if len(tips) != 2 * len(self.parts):
            raise UserError(f"{len(tips)} tips for {len(self.parts)} instruments; give two for each")
        placements = zip(self.parts, tips.reshape(-1, 2, 3), shafts.reshape(-1, 2, 3), strict=True)
        return Shape(
            np.concatenate([bar for placement in placements for bar in place(*placement)]), self.faces
        )

    def glow(self, posed: Shape) -> Floats:
        return reflection.glow(posed, self.alpha, self.bare, self.theatre)

    def touch(self, posed: Shape, surface: Floats) -> tuple[Floats, Floats]:
        indices, distances = _find_close(posed, surface)
        height, share = np.zeros(len(surface)), np.ones(len(surface))
        height[indices] = _CLIMB_MM * np.exp(-np.maximum(distances - _TOUCH_MM, 0) / _REACH_MM)
        share[indices] = 1 - _SHADE * np.exp(-((distances / _SHADE_MM) ** 2))
        return height, share


def _find_close(posed: Shape, surface: Floats) -> tuple[Indices, Floats]:
    """Indices (n,) of points (V, 3) mm that may be near a mesh, and their distances from its vertices."""
    low, high = surface.min(axis=0) - _AWAY_MM, surface.max(axis=0) + _AWAY_MM
    vertices = posed.vertices[((posed.vertices > low) & (posed.vertices < high)).all(axis=1)]
    if not len(vertices):
        return np.zeros(0, np.int32), np.zeros(0)
    low, high = vertices.min(axis=0) - _AWAY_MM, vertices.max(axis=0) + _AWAY_MM
    indices = np.flatnonzero(((surface > low) & (surface < high)).all(axis=1))
    distances, _ = cKDTree(vertices).query(surface[indices], distance_upper_bound=_AWAY_MM)
    return indices.astype(np.int32), np.asarray(distances)


def place(parts: Sequence[Part], tips: Floats, shafts: Floats) -> list[Floats]:
    """Vertices (V, 3) mm of each part of an instrument with its tips and shafts (2, 3)."""
    vertices = []
    for part in parts:
        # The flat sides of two tines face each other; a single blade's faces the tissue.
        if part.side == 0:
            tip, shaft, across = tips.mean(axis=0), shafts.mean(axis=0), np.array([0.0, 0.0, 1.0])
        else:
            tip, shaft = (pair[0 if part.side == 1 else 1] for pair in (tips, shafts))
            across = tips[1] - tips[0]
        vertices.append(tip + part.profile @ _axes(shaft, across))
    return vertices


def shape_of(
    kind: str, footprint_mm: float, size: float = 1.0, meshes: Mapping[str, OwnMesh] = NO_MESHES
) -> tuple[tuple[Part, ...], float]:
    """Parts of an instrument for contacts of that radius a, and half the width [mm] of its tip; both times
    `size`. `meshes`: of further kinds, which have the size of their files."""
    if kind == "none":
        return (), 0.0
    if kind in meshes:
        return (meshes[kind].part.resize(size),), size * meshes[kind].half
    make, share, least, most = SHAPES[kind]
    half = size * float(np.clip(share * footprint_mm, least, most))
    return make(half), half


def build(
    tools: Sequence[tuple[str, float]],
    theatre: Theatre,
    rng: np.random.Generator,
    strength: float = 0.0,
    idle: Sequence[IdleInstrument] = (),
    ground: Floats = np.zeros((1, 3)),
    mm_per_px: float = 0.05,
    meshes: Mapping[str, OwnMesh] = NO_MESHES,
) -> InstrumentMesh | None:
    """Instruments in a theatre, with finishes drawn for each; None if there is none.

    `tools`: kind of each acting one and the radius a of its contacts, mm; `strength`: of the randomization of
    sizes and finishes; `ground`: points (N, 3) mm that cloth lies on; `mm_per_px`: of the picture; `meshes`:
    as of `shape_of`.
    """
    sizes = 1 + strength * (rng.uniform(*_OTHER_SIZES, len(tools)) - 1)
    instruments = [shape_of(kind, a, size, meshes) for (kind, a), size in zip(tools, sizes, strict=True)]
    instruments += [
        ((lay_cloth(instrument, ground, rng),), 0.0)
        if instrument.kind in CLOTH
        else shape_of(instrument.kind, instrument.radius_mm)
        for instrument in idle
    ]
    parts = tuple(shapes for shapes, _ in instruments)
    if not any(parts):
        return None
    textures = list[tuple[Map, FinishMaps]]()
    for bars, kind in zip(
        parts, [*(kind for kind, _ in tools), *(instrument.kind for instrument in idle)], strict=True
    ):
        skin = finish.draw_finish(strength, rng, kind)
        textures += [(part.uv, part.maps(skin, kind, rng, mm_per_px)) for part in bars]
    faces = join_shapes(*(part.shape for bars in parts for part in bars)).faces
    return InstrumentMesh(parts, faces, *stack_maps(textures), theatre)


def lay_cloth(cloth: IdleInstrument, ground: Floats, rng: np.random.Generator) -> Part:
    """A cloth that lies on points (N, 3) mm, gauze in folds."""
    half = cloth.radius_mm, cloth.radius_mm * (0.46 if cloth.kind == "patty" else 0.8)
    rows, columns = (int(2 * side / _SHEET_MM) for side in half)
    sides = (np.linspace(-half[0], half[0], rows), np.linspace(half[1], -half[1], columns))
    u, v = (axis.ravel() for axis in np.meshgrid(*sides, indexing="ij"))  # faces turn upwards
    (tip, _), (shaft, _) = cloth.at(0.0)
    points = np.column_stack([u, v, np.zeros(len(u))])
    _, neighbours = cKDTree(ground[:, :2]).query(
        (tip + points @ _axes(shaft, np.asarray(cloth.aside)))[:, :2], k=6
    )
    ground_z = ground[neighbours % len(ground), 2].max(axis=1).reshape(rows, columns)
    z = np.maximum(gaussian_filter(ground_z, 1.5, mode="nearest"), ground_z) + _LAID_MM
    z[1:-1, 1:-1] += 0.3  # its border is lower
    if cloth.kind == "gauze":
        z += 0.5 * np.maximum(finish_maps.noise(points, 9.0, rng), 0).reshape(z.shape)
    return Part(np.column_stack([u, v, z.ravel() - tip[2]]), 1, rows)


def sweep(s: Floats, thickness: Floats, width: Floats, bow: Floats, power: float) -> Floats:
    """Rings (V, 3) at z = `s`: half axes `thickness`, `width`, shifted by `bow` along x; round at power 1."""
    angle = np.linspace(0, 2 * np.pi, RING, endpoint=False)
    c, w = np.cos(angle), np.sin(angle)
    x = np.sign(c) * np.abs(c) ** power
    y = np.sign(w) * np.abs(w) ** power
    columns = [thickness[:, None] * x + bow[:, None], width[:, None] * y, np.repeat(s[:, None], len(x), 1)]
    return np.stack(columns, -1).reshape(-1, 3)


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


def _along() -> Floats:
    """Positions (R,) mm of rings along an instrument, closer at its tip, two where a coat may begin."""
    coats = np.add.outer(finish.COATS_MM, [-0.02, 0.02]).ravel()
    return np.sort(np.concatenate([np.linspace(0, 1, _RINGS) ** 1.9 * _LENGTH_MM, coats]))


def _round_off(s: Floats, over: float) -> Floats:
    """Factor that closes a bar's end as an ellipse does, over the first `over` mm."""
    return np.asarray(np.sqrt(np.clip(1 - (1 - np.minimum(s / over + 0.01, 1)) ** 2, 0, 1)))


def _forceps(half: float, aside_mm: float = 0.0) -> tuple[Part, ...]:
    """Two tines: a blunt tip that widens into a flat blade, bowed outwards (to -x for side 1), and the handle
    shifted by `aside_mm`, out of view."""
    s = _along()
    closing = _round_off(s, 0.45)
    width = (half - 0.03 + 0.9 * (1 - np.exp(-s / 9.0)) + 1.3 * (1 - np.exp(-s / 45.0))) * closing
    thickness = (0.34 + 0.42 * (1 - np.exp(-s / 8.0)) + 0.3 * (1 - np.exp(-s / 40.0))) * closing
    bow = 5.5 * (1 - np.exp(-((s / 38.0) ** 1.5)))
    bend = np.clip((s - 24.0) / 14.0, 0, 1)
    shift = np.repeat(aside_mm * bend**2 * (3 - 2 * bend), RING)[:, None] * [0.0, 1.0, 0.0]
    return tuple(Part(sweep(s, thickness, width, -side * bow, 0.7) + shift, side) for side in (1, -1))


def _dissector(half: float) -> tuple[Part, ...]:
    """A small rounded blade on a thin round shaft, slightly bent, that ends in a thicker handle."""
    s = _along()
    closing = _round_off(s, 1.4)
    neck = np.exp(-((s / 5.0) ** 2))
    handle = 1.1 / (1 + np.exp(-(s - 42.0) / 2.0))
    thickness = (0.28 + 0.55 * (1 - neck) + handle) * np.minimum(closing * 1.4, 1)
    width = (0.83 + (half - 0.75) * neck + handle) * closing
    bow = 1.6 * np.exp(-s / 6.0) - 1.6
    return (Part(sweep(s, thickness, width, bow, 0.9), 0),)


def _suction(half: float, bend_mm: float = 2.5, wider_mm: float = 0.9) -> tuple[Part, ...]:
    """A tube, open at its end, bent and wider towards the hand."""
    outside = 0.12 + _along()
    inside = np.array([8.0, 3.0, 1.0, 0.3, 0.05])
    s = np.concatenate([inside, outside])
    widening = 0.05 + wider_mm / (1 + np.exp(-(outside - 55.0) / 4.0))
    radius = half + np.concatenate([np.full(5, -0.3 * min(half, 0.5)), widening])
    radius[5] = half - 0.05  # a blunted edge
    bow = bend_mm * (1 - np.exp(-((s / 45.0) ** 2)))
    return (Part(sweep(s, radius, radius, bow, 1.0), 0),)


def _spatula(half: float) -> tuple[Part, ...]:
    """A flat ribbon with a round end, bent where it leaves the wound."""
    s = _along()
    width = (half + 0.8 * (1 - np.exp(-s / 30.0))) * _round_off(s, half)
    thickness = np.full_like(s, 0.32) * _round_off(s, 0.3)
    bow = 4.0 * (1 - np.exp(-((s / 30.0) ** 2)))
    return (Part(sweep(s, thickness, width, bow, 0.35), 0),)


def _probe(half: float) -> tuple[Part, ...]:
    """A ball on a thin shaft; at 50 degrees its lowest point is the tip."""
    s = _along()
    # A ring of no radius would have faces without area.
    least_radius = np.where(s > half, 0.45 * half, 0.03 * half)
    radius = np.maximum(np.sqrt(np.maximum(half**2 - (s - half) ** 2, 0)), least_radius)
    radius += 1.1 / (1 + np.exp(-(s - 42.0) / 2.0))
    tip_mm, lift_mm = (1 - np.sin(np.radians(50))) * half, np.cos(np.radians(50)) * half
    return (Part(sweep(s - tip_mm, radius, radius, np.full_like(s, lift_mm), 1.0), 0),)


def _rod(half: float, bend: float = 0.0) -> tuple[Part, ...]:
    """A round rod or finger with a round end, straight or bent upwards."""
    s = _along()
    radius = half * _round_off(s, half)
    return (Part(sweep(s, radius, radius, bend * s**2, 1.0), 0),)


SHAPES: dict[str, tuple[Callable[[float], tuple[Part, ...]], float, float, float]] = {
    "forceps": (_forceps, 0.0, 0.45, 0.45),
    "bayonet": (partial(_forceps, aside_mm=13.0), 0.0, 0.45, 0.45),
    "dissector": (_dissector, 0.0, 1.5, 1.5),
    "suction": (_suction, 0.48, 1.0, 2.0),
    "spatula": (_spatula, 0.8, 1.5, 4.5),
    "probe": (_probe, 0.5, 0.6, 3.0),
    "rod": (_rod, 1.0, 0.25, 4.0),
    "bent": (partial(_rod, bend=6e-3), 1.0, 0.25, 4.0),
    "tube": (partial(_suction, bend_mm=0.0, wider_mm=0.0), 1.0, 0.5, 4.0),
    "finger": (partial(_rod, bend=4e-3), 1.0, 6.5, 8.5),
}
"""Parts of each drawn kind by half the width of its tip: a share of the contact's radius, from and to mm."""
