"""Objects around an opening: a retractor's blade over its edge, clips and hooks along the cut skin, patties.

Sizes are those of common retractors and scalp clips, at the scale of the opening; chosen by eye.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from synth.arrays import Floats, Map
from synth.geometry.triangles import Shape, grid_faces, join_shapes
from synth.render import instrument
from synth.render.anatomy.layers import Rgb
from synth.render.anatomy.rim import Rim
from synth.render.appearance import reflection
from synth.render.appearance.reflection import Theatre
from synth.render.camera.camera import Camera, project
from synth.render.finish import Finish, draw_finish
from synth.render.finish_maps import RING
from synth.render.idle import IdleInstrument
from synth.render.instrument import Part
from synth.render.materials import Body, FinishMaps, Metal, read_map, stack_maps

_DULL = Finish(  # a retractor's, darkened against glare
    (0.38, 0.365, 0.35), 0.2, 2.0, scattered=0.05, wear=0.35, blood=0.3, blood_mm=5.0, wet_mm=3.0
)
_WIRE = Finish((0.6, 0.58, 0.55), 0.12, 2.0, scattered=0.1, wear=0.3, blood_mm=4.0)
_CLIP_MM = 4.6, 2.7  # length along the skin's edge and radius
_GROUPS, _TOGETHER = (2, 5), (1, 3)  # clips: numbers of groups, and in each
_GAP_MM, _BEHIND_MM = 1.2, 0.5  # between two, and from the skin's edge
_FOLD = 0.86, 26, 0.1  # of skin that they grip: radius as a share of theirs, its rings, and its unevenness
_FLESH = Finish((0.5, 0.5, 0.5), 0.3, coat=(0.4, 0.07, 0.04), coat_alpha=0.25, bare_mm=-1.0)
_MARGIN = 0.15  # of the picture, outside which an object is left out
_COLOURS = (0.008, 0.014, 0.16), (0.008, 0.014, 0.16), (0.02, 0.06, 0.28), (0.6, 0.62, 0.64)  # blues, white
_HOOKS, _HOOK_MM = (2, 5), 0.36  # their number, and the radius of their wire
_PATTIES, _PATTY_MM = (1, 4), (2.2, 3.6)  # their number, and half their length
_INSIDE_MM = 0.4, 1.3  # by which a patty reaches over the opening's edge
_STRING: tuple[Rgb, ...] = (0.03, 0.05, 0.16), (0.02, 0.06, 0.04), (0.03, 0.03, 0.03)
_STRING_MM = 0.13  # its radius


def build_retractor(edge: Floats, theatre: Theatre, ground: Floats, seed: int, mm_per_px: float) -> Body:
    """A straight blade on the rim, its end over the opening's edge, of radii (A,) mm at even angles."""
    rng = np.random.default_rng([seed, 5])
    turn, tilt, overlap_mm, width = rng.uniform((0, 0.1, 1.5, 3.5), (2 * np.pi, 0.2, 3.5, 5.2))
    parts, half = instrument.shape_of("spatula", float(width))
    direction, up = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([0.0, 0.0, 1.0])
    start = float(edge[int(turn / (2 * np.pi) * len(edge))]) - overlap_mm
    along, aside = ground @ direction - start, np.abs(ground @ np.cross(up, direction))
    is_under = (along > 0) & (aside < half + 0.5)
    height = float((ground[is_under, 2] - np.tan(tilt) * along[is_under]).max()) + 0.5
    tip, shaft = start * direction + height * up, np.cos(tilt) * direction + np.sin(tilt) * up
    maps = parts[0].maps(_DULL, "spatula", rng, mm_per_px)
    (vertices,) = instrument.place(parts, np.stack([tip, tip]), np.stack([shaft, shaft]))
    blade = Shape(vertices, parts[0].shape.faces)
    alpha, bare = np.full(len(vertices), _DULL.alpha), np.ones(len(vertices))
    steel = Metal(maps, reflection.glow(blade, alpha, bare, theatre))
    return Body(*blade, parts[0].uv, steel)


def build_clips(
    rim: Rim, scale: float, theatre: Theatre, ground: Floats, seed: int, camera: Camera
) -> list[Body]:
    """Clips along the cut edge of the skin around the opening, in groups, those in view, as one body at most.

    `scale`: mm in a mm of the rim; `ground`: points (N, 3) mm on which they sit.
    """
    rng = np.random.default_rng([seed, 6])
    colour = _COLOURS[rng.integers(len(_COLOURS))]
    bars = list[Bar]()
    count, first = int(rng.integers(*_GROUPS)), rng.uniform(0, 2 * np.pi)
    for group in range(count):
        turn = first + 2 * np.pi * group / count + rng.normal(0, 0.25)
        middles = list[Floats]()
        for _ in range(rng.integers(*_TOGETHER)):
            distance = scale * (_find_radius(rim, rim.skin, turn) + _BEHIND_MM)
            turn += (_CLIP_MM[0] + _GAP_MM) / distance
            skew, blood = float(rng.normal(0, 0.12)), float(rng.uniform(0.0, 0.14))
            middle = _set_on_ground(ground, distance * _direction(turn), 0.1 * _CLIP_MM[1])
            # On the highest of what it would cut into.
            below = ground[np.hypot(*(ground - middle)[:, :2].T) < _CLIP_MM[1]]
            middle[2] = max(middle[2], float(np.percentile(below[:, 2], 95)) if len(below) else -np.inf)
            if not _in_view(camera, middle):
                continue
            along = np.array([-np.sin(turn + skew), np.cos(turn + skew), 0.1 * np.sin(9 * turn)])
            along *= _CLIP_MM[0] / np.linalg.norm(along)
            part = _clip()
            s = part.profile[::RING, 2] / _CLIP_MM[0]
            skin = Finish(
                (0.6, 0.6, 0.6), 0.3, coat=colour, coat_alpha=0.26, bare_mm=-1.0, blood=blood, blood_mm=6.0
            )
            bars.append(Bar(part, 16, middle + (s[:, None] - 0.5) * along, skin, "clip"))
            middles.append(middle)
        if middles:
            bars.append(_fold(np.array(middles), ground, rng))
    return _bodies(bars, theatre, rng, 1.5 * camera.mm_per_px)


def build_hooks(
    rim: Rim, scale: float, theatre: Theatre, ground: Floats, seed: int, camera: Camera
) -> list[Body]:
    """Blunt hooks of wire that hold back the wound's wall, drawn outwards; as `build_clips`."""
    rng = np.random.default_rng([seed, 8])
    bars = list[Bar]()
    turns = rng.uniform(0, 2 * np.pi) + np.arange(n := rng.integers(*_HOOKS)) * 2 * np.pi / n
    for turn in turns + rng.normal(0, 0.3, n):
        direction = _direction(float(turn) + float(rng.normal(0, 0.15)))
        distance = scale * (_find_radius(rim, rim.skin, float(turn)) - 0.6)
        foot = _set_on_ground(ground, distance * _direction(float(turn)), 0.0)
        if not _in_view(camera, foot):
            continue
        # From inside the wound over its edge, then down to the skin and straight out of view.
        crest = _set_on_ground(ground, foot + 1.6 * direction, 0.9)
        bend = np.linspace(-0.6, 0.5, 9)[:, None] * np.pi
        start = foot + 0.6 * direction
        height = max(float(crest[2] - foot[2]), 0.8)
        arc = start + 1.1 * np.sin(bend) * direction + [0, 0, 1] * (height * np.cos(bend) - 0.1)
        tail = arc[-1] + np.linspace(0.8, 14.0, 5)[:, None] * np.array([*direction[:2], 0.12])
        path = np.concatenate([arc, tail])
        steel = replace(_WIRE, blood=float(rng.uniform(0, 0.4)))
        bars.append(Bar(wire(path, _HOOK_MM), 8, path, steel, "hook"))
    return _bodies(bars, theatre, rng, camera.mm_per_px)


def build_patties(
    rim: Rim, scale: float, theatre: Theatre, ground: Floats, seed: int, camera: Camera
) -> list[Body]:
    """Patties of cotton on the rim, over the opening's edge by a millimetre, each with a string outwards."""
    rng = np.random.default_rng([seed, 9])
    string = _STRING[rng.integers(len(_STRING))]
    bodies, bars = list[Body](), list[Bar]()
    for _ in range(rng.integers(*_PATTIES)):
        turn, half = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(*_PATTY_MM))
        skew, overlap_mm = float(rng.normal(0, 0.5)), float(rng.uniform(*_INSIDE_MM))
        direction = _direction(turn + skew)
        middle = (scale * _find_radius(rim, 0 * rim.skin, turn) - overlap_mm) * _direction(
            turn
        ) + half * direction
        if not _in_view(camera, _set_on_ground(ground, middle, 0.0)):
            continue
        (x, y, _), tip = direction.tolist(), (float(middle[0]), float(middle[1]), 0.0)
        cloth = IdleInstrument("patty", half, tip, (0.0, 0.0, 1.0), (x, y, 0.0), gap_mm=1e-3)
        part = instrument.lay_cloth(cloth, ground, rng)
        (vertices,) = instrument.place([part], *cloth.at(0.0))
        blood = float(rng.uniform(0.0, 0.22))
        felt = replace(draw_finish(0.0, rng, "patty"), blood=blood, blood_mm=0.6 * half)
        maps = part.maps(felt, "patty", rng, camera.mm_per_px)
        sheet = Shape(vertices, part.shape.faces)
        bodies.append(_body(sheet, part.uv, maps, theatre, np.full(len(vertices), 0.9)))
        start, curl = middle + 0.9 * half * direction, rng.normal(0, 0.5, 2)
        s = np.linspace(0, 1, 18)[:, None]
        side = np.array([-direction[1], direction[0], 0.0])
        points = (
            start
            + 16 * s * direction
            + side * (16 * (curl[0] * s**2 + 0.3 * curl[1] * np.sin(2 * np.pi * s)))
        )
        path = np.stack([_set_on_ground(ground, point, 0.35) for point in points])
        path[:, 2] = gaussian_filter1d(path[:, 2], 1.0, mode="nearest") + 0.15
        thread = Finish((0.5, 0.5, 0.5), 0.5, coat=string, coat_alpha=0.5, bare_mm=-1.0)
        bars.append(Bar(wire(path, _STRING_MM), 4, path, thread, "string"))
    return bodies + _bodies(bars, theatre, rng, 2 * camera.mm_per_px)


ALONG_RIM: dict[str, Callable[[Rim, float, Theatre, Floats, int, Camera], list[Body]]] = {
    "clips": build_clips,
    "hooks": build_hooks,
    "patties": build_patties,
}
"""What is set along the rim, by its name in `render.scenery`."""


@dataclass(frozen=True)
class Bar:
    """A bar of rings along a path."""

    part: Part  # straight
    sides: int  # of its cross-section, of a part's `RING`
    path: Floats  # (R, 3) mm: middles of its rings
    finish: Finish
    kind: str

    @property
    def shape(self) -> Shape:
        tangents = np.gradient(self.path, axis=0)
        # Two rings in one place close an end: without a direction the outer one would fall flat, into faces
        # without area, whose light is undefined.
        for end, inner in ((0, 1), (-1, -2)):
            if not tangents[end].any():
                tangents[end] = tangents[inner]
        tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
        # Upwards where it is level, so that the shown half of its texture faces the microscope.
        normals = np.cross(tangents, [0.0, 0.0, 1.0])
        level = np.linalg.norm(normals, axis=1, keepdims=True)
        mean = normals.sum(axis=0) / max(float(np.linalg.norm(normals.sum(axis=0))), 1e-9)
        normals = np.where(level > 0.1, normals / np.maximum(level, 1e-9), mean)
        up = np.cross(normals, tangents)
        rings = self.part.profile.reshape(len(self.path), RING, 3)[:, :: RING // self.sides]
        points = self.path[:, None] + rings[..., :1] * up[:, None] + rings[..., 1:2] * normals[:, None]
        return Shape(points.reshape(-1, 3), grid_faces(len(rings), self.sides, "columns").reshape(-1, 3))

    @property
    def uv(self) -> Map:
        places = self.part.uv.reshape(len(self.path), RING, 2)[:, :: RING // self.sides]
        return np.ascontiguousarray(places.reshape(-1, 2))


def _bodies(bars: list[Bar], theatre: Theatre, rng: np.random.Generator, mm_per_px: float) -> list[Body]:
    """All bars as one body, or none."""
    if not bars:
        return []
    shape = join_shapes(*(bar.shape for bar in bars))
    textures = [(bar.uv, bar.part.maps(bar.finish, bar.kind, rng, mm_per_px)) for bar in bars]
    uv, maps = stack_maps(textures)
    alpha = np.concatenate([np.full(len(bar.uv), bar.finish.alpha) for bar in bars])
    return [_body(shape, uv, maps, theatre, alpha)]


def _body(shape: Shape, uv: Map, maps: FinishMaps, theatre: Theatre, alpha: Floats) -> Body:
    bare = read_map(maps.bare, uv).astype(np.float64)
    return Body(*shape, uv, Metal(maps, reflection.glow(shape, alpha, bare, theatre)))


def _direction(turn: float) -> Floats:
    return np.array([np.cos(turn), np.sin(turn), 0.0])


def _find_radius(rim: Rim, beyond: Floats, turn: float) -> float:
    """Distance [mm] from the middle, in the rim's size, of an outline (A,) `beyond` the opening's edge."""
    place = int(turn % (2 * np.pi) / (2 * np.pi) * len(rim.edge)) % len(rim.edge)
    return float(rim.edge[place] + beyond[place])


def _set_on_ground(ground: Floats, point: Floats, above: float) -> Floats:
    """The point (3,) mm set on the ground's points (N, 3), or `above` it."""
    neighbours = np.argsort(((ground[:, :2] - point[:2]) ** 2).sum(axis=1))[:12]
    return np.array([point[0], point[1], float(ground[neighbours, 2].max()) + above])


def _in_view(camera: Camera, point: Floats) -> bool:
    place = project(camera, point[None])[0] / np.asarray(camera.size)
    return bool(((place > -_MARGIN) & (place < 1 + _MARGIN)).all())


def wire(path: Floats, radius: float) -> Part:
    """A round wire with closed ends, as long as a path (R, 3) mm."""
    s = np.append(0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    r = np.full(len(s), radius)
    r[[0, -1]] *= 0.05
    return Part(instrument.sweep(s, r, r, np.zeros_like(s), 1.0), 0)


def _fold(middles: Floats, ground: Floats, rng: np.random.Generator) -> Bar:
    """The fold of cut skin that clips at `middles` (n, 3) mm, along a line, grip: it sinks in beyond them."""
    share, rings, unevenness = _FOLD
    direction = middles[-1] - middles[0] if len(middles) > 1 else np.cross([0.0, 0.0, 1.0], middles[0])
    direction = direction / max(float(np.linalg.norm(direction)), 1e-9)
    ends = [middles[k] + side * 1.1 * _CLIP_MM[0] * direction for k, side in ((0, -1), (-1, 1))]
    stops = np.array([ends[0], *middles, ends[1]])
    for end in (0, -1):
        stops[end] = _set_on_ground(ground, stops[end], -0.9 * _CLIP_MM[1])
    run = np.append(0, np.linalg.norm(np.diff(stops, axis=0), axis=1).cumsum())
    s = np.linspace(0, run[-1], rings)
    path = gaussian_filter1d(np.stack([np.interp(s, run, axis) for axis in stops.T], axis=1), 1.0, axis=0)
    wave = gaussian_filter1d(rng.standard_normal(rings), 1.5)
    r = share * _CLIP_MM[1] * np.clip(1 + unevenness * wave / max(float(wave.std()), 1e-9), 0.7, 1.12)
    r[[0, -1]] *= 0.05
    flesh = replace(_FLESH, blood=float(rng.uniform(0.1, 0.5)), blood_mm=float(run[-1]))
    return Bar(Part(instrument.sweep(s, r, r, np.zeros_like(s), 0.9), 0), 16, path, flesh, "fold")


def _clip() -> Part:
    """A short round band with a rib at both ends and a broad one in its middle."""
    length, radius = _CLIP_MM
    s = length * np.array([0.0, 0.0, 0.03, 0.16, 0.2, 0.32, 0.36, 0.64, 0.68, 0.8, 0.84, 0.97, 1.0, 1.0])
    r = radius * np.array([0.02, 0.93, 1.0, 1.0, 0.93, 0.93, 0.97, 0.97, 0.93, 0.93, 1.0, 1.0, 0.93, 0.02])
    return Part(instrument.sweep(s, r, r, np.zeros_like(s), 0.8), 0)
