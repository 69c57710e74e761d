"""Content of a craniotomy: cortex, rim with its scenery, instruments, and the microscope's lamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from synth.arrays import Floats, Map
from synth.geometry.triangles import Shape
from synth.job.schema import Job
from synth.render import finish, instrument, own_instrument
from synth.render.anatomy import noise, rim, texture
from synth.render.anatomy.rim import Rim
from synth.render.anatomy.surface import CortexSurface, resized
from synth.render.appearance import light, reflection
from synth.render.appearance.family import Appearance
from synth.render.appearance.reflection import Theatre
from synth.render.camera.camera import Camera
from synth.render.content import SceneContent
from synth.render.finish import Finish
from synth.render.idle import IdleInstrument
from synth.render.materials import Body, Coat, Metal, Wet
from synth.render.randomized import pattern, surroundings
from synth.render.randomized.surroundings import Randomization
from synth.system.recent import Recent

_RIM_ROUGHNESS, _RIM_DRY = 0.09, 0.35
_MIRRORED_PX = 48  # resolution of the wound in steel's reflections, as fine as its finish resolves
_DULL = Finish((0.15, 0.145, 0.14), 0.4, scattered=0.25)  # a retractor's, darkened against glare
_MOST_TEXELS = 1024  # across the maps of a randomised tissue, which may be wider than the picture

# An anatomy that is shown again, as by other gestures on it, keeps the paint of its cortex and its rim.
_COATS = Recent[Coat](2, lambda coat: coat.albedo.nbytes + coat.normal.nbytes + coat.dry.nbytes)


def craniotomy(
    surface: CortexSurface,
    appearance: Appearance,
    camera: Camera,
    job: Job,
    drawn: Sequence[tuple[str, float]] = (),
    idle: Sequence[IdleInstrument] = (),
    how: Randomization | None = None,
) -> SceneContent:
    """The content of one sequence at rest; UserError: the job's photograph cannot be read.

    `drawn`: kind of each acting instrument, `none` for one that is not drawn, and the radius of its contacts
    [mm]; `idle`: those that touch nothing; `how`: what is randomised.
    """
    how = how or Randomization()
    lit = appearance.light.power * light.blackbody(appearance.light.kelvin)
    ambient = appearance.light.ambient * lit
    # Grown and painted in the usual size.
    patch, px_mm = resized(surface, 1 / how.scale), camera.mm_per_px / how.scale
    around = rim.build(patch, job.anatomy.craniotomy.radius_mm / how.scale, appearance, px_mm)
    pixels, texels = (
        min(texture.resolution(extent, one), _MOST_TEXELS if how.scale != 1 else 4096)
        for extent, one in ((patch.chart.extent_mm, px_mm), (around.extent_mm, 2.2 * px_mm))
    )
    if how.pattern is None:
        shade = rim.shade(around, patch) if how.surroundings is None else None
        photo = job.appearance.photo
        paint = partial(texture.cortex, patch, appearance, pixels, photo, shade)
        coat = paint() if photo else _COATS.get(paint, patch, appearance, pixels, shade)
        wet = appearance.roughness, appearance.dry_roughness
        if how.tinted:
            coat = replace(coat, albedo=pattern.tinted(coat.albedo, how.tint, how.tinted))
    else:
        coat = pattern.paint(how.pattern, pixels, patch.chart.extent_mm)
        wet = how.pattern.roughness, appearance.dry_roughness
    cortex = Wet(coat, *wet, ambient, appearance.fluid_index)
    # Where only the truth at rest is needed, the rim stays unpainted, which saves a second.
    paint_rim = partial(rim.paint, around, appearance, texels)
    painted = partial(_COATS.get, paint_rim, around, appearance, texels)
    rim_coat = Wet(painted, _RIM_ROUGHNESS, _RIM_DRY, ambient)
    static = [Body(how.scale * around.shape.vertices, around.shape.faces, around.uv, rim_coat)]
    lamps = light.lamps(camera, appearance.light)
    wound = _wound(patch, around, coat, appearance)
    theatre = Theatre(wound, how.scale * patch.chart.extent_mm, lamps, lit, camera.centre)
    if how.surroundings is not None:
        sizes = job.anatomy.craniotomy.radius_mm, 2 * camera.mm_per_px * camera.size[0]
        sheet = surroundings.sheet(how.surroundings, surface.vertices, *sizes, ambient)
        static = [] if how.surroundings.kind == "nothing" else [sheet]
    ground = np.concatenate([surface.vertices, *(one.vertices for one in static)])
    if "retractor" in appearance.scenery and how.surroundings is None:
        static.append(_retractor(how.scale * around.edge, theatre, ground, appearance.rim_seed))
    hand = np.random.default_rng([appearance.rim_seed, 2])
    strength, own = job.randomize.get("instruments", 0.0), own_instrument.read_own_instruments(job.fem)
    return SceneContent(
        tissue=Body(surface.vertices, surface.faces, surface.uv, cortex),
        lamps=lamps,
        static=static,
        instruments=instrument.build(drawn, theatre, hand, strength, idle, ground, own),
        spot=appearance.light.even,
    )


def _retractor(edge: Floats, theatre: Theatre, ground: Floats, seed: int) -> Body:
    """A straight blade on the rim, its end over the opening's edge."""
    rng = np.random.default_rng([seed, 5])
    turn, lean, inside, wide = rng.uniform((0, 0.1, 1.5, 3.5), (2 * np.pi, 0.2, 3.5, 5.2))
    parts, half = instrument.shape_of("spatula", float(wide))
    out, up = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([0.0, 0.0, 1.0])
    start = float(edge[int(turn / (2 * np.pi) * len(edge))]) - inside
    along, aside = ground @ out - start, np.abs(ground @ np.cross(up, out))
    under = (along > 0) & (aside < half + 0.5)
    high = float((ground[under, 2] - np.tan(lean) * along[under]).max()) + 0.5
    tip, shaft = start * out + high * up, np.cos(lean) * out + np.sin(lean) * up
    dull = finish.reflectance(_DULL, parts[0].profile, instrument.RING, rng)
    (vertices,) = instrument.place(parts, np.stack([tip, tip]), np.stack([shaft, shaft]))
    blade = Shape(vertices, parts[0].shape.faces)
    steel = Metal(dull.diffuse, reflection.glow(blade, dull, theatre))
    return Body(*blade, np.zeros((len(vertices), 2), np.float32), steel)


def _wound(surface: CortexSurface, around: Rim, coat: Coat, appearance: Appearance) -> Map:
    """Colour (n, n, 3) of the cortex with the rim around it, coarse, as steel mirrors it."""
    small = cv2.resize(coat.albedo, (_MIRRORED_PX, _MIRRORED_PX), interpolation=cv2.INTER_AREA)
    # The chart's extent is close enough to the projection's for the finish.
    axis = noise.centres(_MIRRORED_PX, surface.chart.extent_mm)
    inside = rim.inside(around, *np.meshgrid(axis, axis))[..., None]
    outside = 0.5 * (np.asarray(appearance.dura_albedo) + np.asarray(appearance.surroundings_albedo))
    return np.asarray(small * inside + outside.astype(np.float32) * (1 - inside), np.float32)
