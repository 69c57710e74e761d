"""Hard objects around an opening: a retractor's blade over its edge, and clips along the cut skin.

Sizes are those of common retractors and scalp clips, at the scale of the opening; chosen by eye.
"""

from __future__ import annotations

import numpy as np

from synth.arrays import Floats, Map
from synth.geometry.triangles import Shape, joined
from synth.render import instrument
from synth.render.anatomy.rim import Rim
from synth.render.appearance import reflection
from synth.render.appearance.reflection import Theatre
from synth.render.camera.camera import Camera, project
from synth.render.finish import Finish
from synth.render.instrument import Part
from synth.render.materials import Body, FinishMaps, Metal, stack_maps

_DULL = Finish(  # a retractor's, darkened against glare
    (0.38, 0.365, 0.35), 0.2, 2.0, scattered=0.05, wear=0.35, blood=0.3, blood_mm=5.0, wet_mm=3.0
)
_CLIP_MM = 4.4, 1.7  # length and radius
_GROUPS, _TOGETHER = (3, 6), (1, 4)  # clips: numbers of groups, and in each
_GAP_MM, _BEHIND_MM = 1.3, 0.9  # between two, and from the foot of the wound's wall
_MARGIN = 0.15  # of the picture, outside which a clip is left out
_COLOURS = (0.03, 0.06, 0.24), (0.03, 0.06, 0.24), (0.5, 0.55, 0.6)  # blue, or white


def build_retractor(edge: Floats, theatre: Theatre, ground: Floats, seed: int, mm_per_px: float) -> Body:
    """A straight blade on the rim, its end over the opening's edge, of radii (A,) mm at even angles."""
    rng = np.random.default_rng([seed, 5])
    turn, lean, inside, wide = rng.uniform((0, 0.1, 1.5, 3.5), (2 * np.pi, 0.2, 3.5, 5.2))
    parts, half = instrument.shape_of("spatula", float(wide))
    out, up = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([0.0, 0.0, 1.0])
    start = float(edge[int(turn / (2 * np.pi) * len(edge))]) - inside
    along, aside = ground @ out - start, np.abs(ground @ np.cross(up, out))
    under = (along > 0) & (aside < half + 0.5)
    high = float((ground[under, 2] - np.tan(lean) * along[under]).max()) + 0.5
    tip, shaft = start * out + high * up, np.cos(lean) * out + np.sin(lean) * up
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
    shapes, textures, size = list[Shape](), list[tuple[Map, FinishMaps]](), np.asarray(camera.size)
    count, first = int(rng.integers(*_GROUPS)), rng.uniform(0, 2 * np.pi)
    for group in range(count):
        turn = first + 2 * np.pi * group / count + rng.normal(0, 0.25)
        for _ in range(rng.integers(*_TOGETHER)):
            place = int(turn / (2 * np.pi) * len(rim.edge)) % len(rim.edge)
            away = scale * (rim.edge[place] + rim.wall[place] + _BEHIND_MM)
            turn += (_CLIP_MM[0] + _GAP_MM) / away
            skew, blood = float(rng.normal(0, 0.15)), float(rng.uniform(0.02, 0.2))
            out = np.array([np.cos(turn), np.sin(turn), 0.0])
            near = np.linalg.norm(ground[:, :2] - away * out[:2], axis=1) < 1.5
            if not near.any():
                continue
            middle = away * out + [0, 0, float(np.percentile(ground[near, 2], 80)) - 0.1 * _CLIP_MM[1]]
            at = project(camera, middle[None])[0] / size
            if ((at < -_MARGIN) | (at > 1 + _MARGIN)).any():
                continue
            along = np.array([-np.sin(turn + skew), np.cos(turn + skew), 0.1 * np.sin(9 * turn)])
            along /= np.linalg.norm(along)
            part, start = _clip(), middle - 0.5 * _CLIP_MM[0] * along
            (vertices,) = instrument.place([part], np.stack([start, start]), np.stack([along, along]))
            shapes.append(Shape(vertices, part.shape.faces))
            skin = Finish((0.6, 0.6, 0.6), 0.3, coat=colour, bare_mm=-1.0, blood=blood, blood_mm=9.0)
            textures.append((part.uv, part.maps(skin, "clip", rng, 2 * camera.mm_per_px)))
    if not shapes:
        return []
    whole = joined(*shapes)
    uv, maps = stack_maps(textures)
    alpha, bare = np.full(len(whole.vertices), 0.3), np.zeros(len(whole.vertices))
    glow = reflection.glow(whole, alpha, bare, theatre)
    return [Body(*whole, uv, Metal(maps, glow))]


def _clip() -> Part:
    """A short tube with a rib at both ends."""
    length, radius = _CLIP_MM
    s = length * np.array([0.0, 0.0, 0.04, 0.2, 0.26, 0.74, 0.8, 0.96, 1.0, 1.0])
    r = radius * np.array([0.02, 0.9, 1.0, 1.0, 0.86, 0.86, 1.0, 1.0, 0.9, 0.02])
    return Part(instrument.sweep(s, r, r, np.zeros_like(s), 1.0), 0)
