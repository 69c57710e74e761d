"""Content of a craniotomy: cortex, rim with its scenery, instruments, and the microscope's lamps."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np

from synth.arrays import Map
from synth.job.schema import Job
from synth.render import instrument
from synth.render.anatomy import noise, rim, scenery, texture
from synth.render.anatomy.rim import Rim
from synth.render.anatomy.surface import CortexSurface
from synth.render.appearance import light, reflection
from synth.render.appearance.family import Appearance
from synth.render.appearance.reflection import Theatre
from synth.render.camera.camera import Camera
from synth.render.content import SceneContent
from synth.render.materials import Body, Coat, Metal, Wet

_RIM_ROUGHNESS, _RIM_DRY = 0.09, 0.35
_MIRRORED_PX = 48  # resolution of the wound in steel's reflections, as fine as its finish resolves
_DULL = 0.8  # finish of a retractor, between steel (0) and black (1), against glare
_AMBIENT = 0.05  # share of the lamps' light that comes from all directions


def craniotomy(
    surface: CortexSurface,
    appearance: Appearance,
    camera: Camera,
    job: Job,
    drawn: Sequence[tuple[str, float]] = (),
) -> SceneContent:
    """The content of one sequence at rest; UserError: the job's photograph cannot be read.

    `drawn`: kind of each instrument, `none` for one that is not drawn, and the radius of its contacts [mm].
    """
    lit = appearance.light.power * light.blackbody(appearance.light.kelvin)
    around = rim.build(surface, job.anatomy.craniotomy.radius_mm, appearance, camera.mm_per_px)
    pixels = texture.resolution(surface.chart.extent_mm, camera.mm_per_px)
    coat = texture.cortex(surface, appearance, pixels, job.appearance.photo, rim.shade(around, surface))
    cortex = Wet(coat, appearance.roughness, appearance.dry_roughness, _AMBIENT * lit, appearance.fluid_index)
    texels = texture.resolution(around.extent_mm, 2.2 * camera.mm_per_px)
    # Where only the truth at rest is needed, the rim stays unpainted, which saves a second.
    painted = partial(rim.paint, around, appearance, texels)
    static = [Body(*around.shape, around.uv, Wet(painted, _RIM_ROUGHNESS, _RIM_DRY, _AMBIENT * lit))]
    lamps = light.lamps(camera, appearance.light)
    wound = _wound(surface, around, coat, appearance)
    theatre = Theatre(wound, surface.chart.extent_mm, lamps, lit, camera.centre, seed=appearance.rim_seed)
    if "retractor" in appearance.scenery:
        static.append(_retractor(surface, around, theatre))
    hand = np.random.default_rng([appearance.rim_seed, 2])
    return SceneContent(
        tissue=Body(surface.vertices, surface.faces, surface.uv, cortex),
        lamps=lamps,
        static=static,
        instruments=instrument.build(drawn, theatre, hand),
        spot=appearance.light.even,
    )


def _retractor(surface: CortexSurface, around: Rim, theatre: Theatre) -> Body:
    """The blade over the rim."""
    points = np.concatenate([surface.vertices, around.shape.vertices])
    blade = scenery.retractor(around.edge, points, np.random.default_rng([theatre.seed, 5]))
    dull = np.full(len(blade.vertices), _DULL, np.float32)
    steel = Metal(reflection.tint(dull), reflection.glow(blade, dull, theatre))
    return Body(*blade, np.zeros((len(dull), 2), np.float32), steel)


def _wound(surface: CortexSurface, around: Rim, coat: Coat, appearance: Appearance) -> Map:
    """Colour (n, n, 3) of the cortex with the rim around it, coarse, as steel mirrors it."""
    small = cv2.resize(coat.albedo, (_MIRRORED_PX, _MIRRORED_PX), interpolation=cv2.INTER_AREA)
    # The chart's extent is close enough to the projection's for the finish.
    axis = noise.centres(_MIRRORED_PX, surface.chart.extent_mm)
    inside = rim.inside(around, *np.meshgrid(axis, axis))[..., None]
    outside = 0.5 * (np.asarray(appearance.dura_albedo) + np.asarray(appearance.surroundings_albedo))
    return np.asarray(small * inside + outside.astype(np.float32) * (1 - inside), np.float32)
