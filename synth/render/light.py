"""The microscope's lamps: a pair of coaxial beams beside the objective, and a ring around it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from synth.render.camera import Camera
from synth.render.look import Look
from synth.render.mitsuba_adapter import Lamp

Floats = npt.NDArray[np.float64]

_RING_MM = 48.0


def lamps(camera: Camera, look: Look) -> list[Lamp]:
    """Lamps that together give a white surface, square to them at the craniotomy, a radiance of about 1."""
    colour = blackbody(look.kelvin)
    distance = float(np.linalg.norm(camera.centre))
    target = np.zeros(3)
    right, down, forward = camera.rotation
    angle = np.deg2rad(look.lamp_azimuth_deg)
    sideways = np.cos(angle) * right + np.sin(angle) * down
    lean = np.deg2rad(look.lamp_tilt_deg)
    main = distance * (np.cos(lean) * -forward + np.sin(lean) * sideways)
    field = camera.size[0] * camera.mm_per_px
    beam = np.rad2deg(np.arctan(0.40 * field / distance))
    cutoff = np.rad2deg(np.arctan(0.95 * field / distance))
    # Radiance of a white diffuser is I / (pi d^2).
    total = np.pi * distance**2

    def lamp(position: Floats, share: float, weight: float) -> Lamp:
        r, g, b = (share * total * colour).tolist()
        return Lamp(position, target, (r, g, b), float(cutoff), float(beam), weight)

    # Two points stand for the ring. With weights 2:1:1 the four strata of a multijittered pixel look at the
    # same lamps in every pixel, and the choice of a lamp makes no noise.
    made = [lamp(main, look.coaxial, 2.0)]
    for around in (angle + 0.6 * np.pi, angle + 1.4 * np.pi):
        offset = _RING_MM * (np.cos(around) * right + np.sin(around) * down)
        made.append(lamp(camera.centre + offset, (1 - look.coaxial) / 2, 1.0))
    return made


def blackbody(kelvin: float) -> Floats:
    """Linear sRGB colour (3,) of a black body, luminance 1.

    Planckian locus of Y.-S. Kim et al. (US 7,024,034, 2006), 4000-25000 K; below 4000 K its other branch.
    """
    t = 1e3 / kelvin
    if kelvin < 4000:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    xyz = np.array([x / y, 1.0, (1 - x - y) / y])
    matrix = np.array(
        [
            [3.2404542, -1.5371385, -0.4985314],
            [-0.9692660, 1.8760108, 0.0415560],
            [0.0556434, -0.2040259, 1.0572252],
        ]
    )
    return np.asarray(np.maximum(matrix @ xyz, 0.0), np.float64)
