"""Content of a craniotomy: cortex, rim with its scenery, instruments, and the microscope's lamps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from synth.arrays import Floats, Map, Mask
from synth.render import instrument, scenery
from synth.render.anatomy import noise, rim, texture
from synth.render.anatomy.rim import Rim
from synth.render.anatomy.surface import CortexSurface, resize
from synth.render.appearance import light
from synth.render.appearance.family import Appearance
from synth.render.appearance.reflection import Theatre
from synth.render.camera.camera import Camera, to_camera, to_pixels
from synth.render.content import SceneContent
from synth.render.idle import IdleInstrument
from synth.render.instrument import NO_MESHES, OwnMesh
from synth.render.materials import Body, Coat, Wet
from synth.render.randomized import pattern, surroundings
from synth.render.randomized.surroundings import Randomization
from synth.system.recent import Recent

_RIM_ROUGHNESS, _RIM_DRY = 0.04, 0.28
_SEEN = 1.3  # distance of what is ever seen from the middle, in halves of the picture's diagonal at rest
_SQUARES, _RIM_MM = 64, 2.0  # across the rim's map, to tell which of it is seen; its height
_MIRRORED_PX = 48  # resolution of the wound in steel's reflections, as fine as its finish resolves
_MOST_TEXELS = 1024  # across the maps of a randomised tissue, which may be wider than the picture

# An anatomy that is shown again, as by other gestures on it, keeps the paint of its cortex and its rim.
_COATS = Recent[Coat](2, lambda coat: coat.albedo.nbytes + coat.normal.nbytes + coat.dry.nbytes)


def build_craniotomy(
    surface: CortexSurface,
    appearance: Appearance,
    camera: Camera,
    opening_mm: float,
    tools: Sequence[tuple[str, float]] = (),
    idle: Sequence[IdleInstrument] = (),
    randomization: Randomization | None = None,
    *,
    photo: Path | None = None,
    wear: float = 0.0,
    meshes: Mapping[str, OwnMesh] = NO_MESHES,
) -> SceneContent:
    """The content of one sequence at rest; UserError: the photograph cannot be read.

    `opening_mm`: radius of the opening; `tools`: kind of each acting instrument, `none` for one that is not
    drawn, and the radius of its contacts [mm]; `idle`: those that touch nothing; `randomization`: what is
    randomised; `photo`: a photograph as albedo; `wear`: strength of `randomize.instruments`, that of their
    steel; `meshes`: of kinds of one's own.
    """
    randomization = randomization or Randomization()
    lamp_colour = appearance.light.power * light.blackbody(appearance.light.kelvin)
    ambient = appearance.light.ambient * lamp_colour
    # Grown and painted in the usual size.
    patch, px_mm = resize(surface, 1 / randomization.scale), camera.mm_per_px / randomization.scale
    seen_mm = _SEEN * 0.5 * float(np.hypot(*camera.size)) * px_mm
    opening_rim = rim.build(patch, opening_mm / randomization.scale, appearance, px_mm, seen_mm)
    lamps = light.lamps(camera, appearance.light)
    slopes = light.mirror_slopes(camera, lamps[0])
    coat = _paint_cortex(patch, opening_rim, appearance, px_mm, slopes, randomization, photo)
    roughness = appearance.roughness if randomization.pattern is None else randomization.pattern.roughness
    cortex = Wet(coat, roughness, appearance.dry_roughness, ambient, appearance.fluid_index)
    wound = _wound(patch, opening_rim, coat, appearance)
    theatre = Theatre(wound, randomization.scale * patch.chart.extent_mm, lamp_colour, camera.centre)
    if randomization.surroundings is None:
        rim_body = _build_rim(opening_rim, appearance, camera, px_mm, ambient, randomization.scale)
        static = [
            rim_body,
            *_place_scenery(opening_rim, appearance, camera, theatre, surface, rim_body, randomization.scale),
        ]
    else:
        sizes = opening_mm, 2 * camera.mm_per_px * camera.size[0]
        sheet = surroundings.sheet(randomization.surroundings, surface.vertices, *sizes, ambient)
        static = [] if randomization.surroundings.kind == "nothing" else [sheet]
    rng = np.random.default_rng([appearance.rim_seed, 2])
    ground = _gather_ground(surface, static[:1])
    # In the corners of the patch, farther under the rim than at its sides.
    corners = np.hypot(*surface.vertices[:, :2].T) > 0.5 * surface.extent_mm
    return SceneContent(
        tissue=Body(surface.vertices, surface.faces, surface.uv, cortex),
        hidden=corners[surface.faces].all(axis=1) if randomization.surroundings is None else None,
        lamps=lamps,
        static=static,
        instruments=instrument.build(tools, theatre, rng, wear, idle, ground, camera.mm_per_px, meshes),
        spot=appearance.light.even,
    )


def _paint_cortex(
    patch: CortexSurface,
    opening_rim: Rim,
    appearance: Appearance,
    px_mm: float,
    slopes: tuple[float, float, float],
    randomization: Randomization,
    photo: Path | None,
) -> Coat:
    """The maps of the tissue; `px_mm`: of a pixel on it, in the usual size; `slopes`: `mirror_slopes`."""
    pixels = _count_texels(patch.chart.extent_mm, px_mm, randomization.scale)
    if randomization.pattern is not None:
        return pattern.paint(randomization.pattern, pixels, patch.chart.extent_mm)
    x, y, rise = slopes
    mirror = x, y, rise * randomization.scale
    shade = rim.shade(opening_rim, patch) if randomization.surroundings is None else None
    paint = partial(texture.cortex, patch, appearance, pixels, photo, shade, mirror)
    coat = paint() if photo else _COATS.get(paint, patch, appearance, pixels, shade, mirror)
    if randomization.tinted:
        coat = replace(coat, albedo=pattern.apply_tint(coat.albedo, randomization.tint, randomization.tinted))
    return coat


def _build_rim(
    opening_rim: Rim, appearance: Appearance, camera: Camera, px_mm: float, ambient: Floats, scale: float
) -> Body:
    """The rim, painted only when it is first rendered: truth at rest needs no paint, which takes a second."""
    texels = _count_texels(opening_rim.extent_mm, 2.2 * px_mm, scale)
    visible_squares = _find_visible(camera, opening_rim.extent_mm, scale)
    paint = partial(rim.paint, opening_rim, appearance, texels, visible_squares)
    cached_paint = partial(_COATS.get, paint, opening_rim, appearance, texels, visible_squares)
    # Only faces that may be seen: all bodies' trees are made anew every frame.
    column, row = np.clip((opening_rim.uv * _SQUARES).astype(int), 0, _SQUARES - 1).T
    visible_faces = visible_squares[row, column][opening_rim.shape.faces].any(axis=1)
    visible_faces[:1] = True  # a mesh has a face, even if the picture shows tissue from edge to edge
    finish = Wet(cached_paint, _RIM_ROUGHNESS, _RIM_DRY, ambient)
    return Body(
        scale * opening_rim.shape.vertices, opening_rim.shape.faces[visible_faces], opening_rim.uv, finish
    )


def _place_scenery(
    opening_rim: Rim,
    appearance: Appearance,
    camera: Camera,
    theatre: Theatre,
    surface: CortexSurface,
    rim_body: Body,
    scale: float,
) -> list[Body]:
    """What lies on the rim, `rim_body`: retractor, clips, drapes."""
    ground, seed = _gather_ground(surface, [rim_body]), appearance.rim_seed
    bodies: list[Body] = []
    if "retractor" in appearance.scenery:
        bodies.append(
            scenery.build_retractor(scale * opening_rim.edge, theatre, ground, seed, camera.mm_per_px)
        )
    for name, build_objects in scenery.ALONG_RIM.items():
        if name in appearance.scenery:
            bodies += build_objects(opening_rim, scale, theatre, ground, seed, camera)
    return bodies


def _gather_ground(surface: CortexSurface, bodies: Sequence[Body]) -> Floats:
    """Points (V, 3) mm of the tissue and what surrounds it, on which things lie."""
    return np.concatenate([surface.vertices, *(body.vertices for body in bodies)])


def _count_texels(extent_mm: float, px_mm: float, scale: float) -> int:
    """Width of a map of that extent for pixels of `px_mm`."""
    return min(texture.resolution(extent_mm, px_mm), _MOST_TEXELS if scale != 1 else 4096)


def _find_visible(camera: Camera, extent_mm: float, scale: float) -> Mask:
    """Whether squares (n, n) of the rim's map may be in the picture of the camera, wherever it moves."""
    axis = scale * noise.centres(_SQUARES, extent_mm)
    x, y = np.meshgrid(axis, axis)
    local = to_camera(camera, np.column_stack([x.ravel(), y.ravel(), np.full(x.size, _RIM_MM)]))
    with np.errstate(all="ignore"):
        undistorted = (local[:, :2] / local[:, 2:]) * np.diag(camera.K)[:2] + camera.K[:2, 2]
        places = np.stack([undistorted, to_pixels(camera, local)])
    size, margin = np.asarray(camera.size), (_SEEN - 1) * 0.5 * float(np.hypot(*camera.size))
    inside = (np.abs(places - 0.5 * size) < 0.5 * size + margin).all(axis=-1).any(axis=0)
    return np.asarray((inside | (local[:, 2] < 1)).reshape(x.shape))


def _wound(surface: CortexSurface, opening_rim: Rim, coat: Coat, appearance: Appearance) -> Map:
    """Colour (n, n, 3) of the cortex with the rim around it, coarse, as steel mirrors it."""
    albedo = cv2.resize(coat.albedo, (_MIRRORED_PX, _MIRRORED_PX), interpolation=cv2.INTER_AREA)
    # The chart's extent is close enough to the projection's for the finish.
    axis = noise.centres(_MIRRORED_PX, surface.chart.extent_mm)
    inside = rim.inside(opening_rim, *np.meshgrid(axis, axis))[..., None]
    outside = 0.5 * (np.asarray(appearance.dura_albedo) + np.asarray(appearance.surroundings_albedo))
    return np.asarray(albedo * inside + outside.astype(np.float32) * (1 - inside), np.float32)
