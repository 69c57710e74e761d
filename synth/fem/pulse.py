"""Pulse of heart and breath: a pressure from below raises and lowers the exposed surface.

In tissue that hardly changes its volume, a pressure inside equals a pull of that size on the part that the
skull leaves open. So the pulse is a load on the opening, scaled to the requested motion; it belongs to no
instrument and to no label.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.arrays import Floats
from synth.fem.mesh.tetrahedra import RIM_MM
from synth.fem.surface_embedding import Embedding
from synth.fem.system import System
from synth.geometry.triangles import Shape

HEART_HZ, BREATH_HZ = (1.0, 1.7), (0.2, 0.35)
"""Heart and breathing rate of an adult at rest: 60 to 102 and 12 to 21 a minute. On the exposed brain their
peaks lie at 1 and 0.2 Hz (Faria et al., Med. Phys. 41, 2014)."""

_SECOND = 0.4  # share of twice the heart's rate: a steep rise and a slow fall
_PEAK_TO_PEAK = 2.4293  # of that wave
_MIDDLE = 0.25  # part of the opening's radius over which its motion is averaged


@dataclass(frozen=True)
class Pulse:
    """Amplitudes, rates and phases of the pulse in one sequence."""

    heart_mm: float  # motion of the middle of the opening with the heart, peak to peak
    heart_hz: float
    heart_rad: float  # phase in frame 0
    breath_mm: float  # likewise with the breath
    breath_hz: float
    breath_rad: float

    def height(self, time: Floats) -> Floats:
        """Height (T,) mm of the opening's middle over its place in frame 0, at times (T,) s from frame 0."""
        heart, breath = (
            rad + 2 * np.pi * hz * np.append(0.0, time)
            for rad, hz in ((self.heart_rad, self.heart_hz), (self.breath_rad, self.breath_hz))
        )
        wave = (np.sin(heart) + _SECOND * np.sin(2 * heart)) / _PEAK_TO_PEAK
        rise = self.heart_mm * wave + 0.5 * self.breath_mm * np.sin(breath)
        return np.asarray(rise[1:] - rise[0])


def lift(system: System, embedding: Embedding, surface: Shape, opening_mm: float) -> Floats:
    """The load that raises the middle of the opening by 1 mm under the linear law, (N, 3) mN for E = 1 kPa.

    `surface` is embedded in the volume, its faces counter-clockwise from outside; beyond the radius
    `opening_mm` of the craniotomy the pressure falls to 0 over the rim.
    """
    vertices, faces = surface
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 6
    outward = np.zeros_like(vertices)
    np.add.at(outward, faces.ravel(), np.repeat(normal, 3, axis=0))
    reach = np.hypot(vertices[:, 0], vertices[:, 1])
    exposure = np.clip(1 - (reach - opening_mm) / RIM_MM, 0, 1)
    load = embedding.gather((exposure * exposure * (3 - 2 * exposure))[:, None] * outward)
    middle = reach <= max(_MIDDLE * opening_mm, float(reach.min()))
    return np.asarray(load / embedding.move(system.solve(load))[middle, 2].mean())
