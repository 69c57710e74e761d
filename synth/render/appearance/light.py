"""The microscope's lamps: two windows next to its lens, so near to the axis that shadows are short.

Their angles and the spot's fall-off were chosen by eye; no microscope was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from synth.arrays import Floats, Map
from synth.render.camera.camera import Camera
from synth.render.materials import Lamp

_APART = 2.2  # between the lamps, round the optical axis [rad]
_STEEPEST_DEG = 6.5
_EDGE = 2**-0.25  # radius of the spot that is called its own, as a share of that of half its light
_OPENING = 0.37  # radius of a usual opening in widths of the field, whose mean light no spot changes
_BRIGHTEST = 1.25  # in the middle of a spot far smaller than it
_RAYS = 65  # across a picture
_LOWEST = 0.17  # height of any lamp over the opening's plane, as a share of its distance
_WINDOW_DEG = 0.7  # angular radius of a lamp's window at the tissue


@dataclass(frozen=True)
class FreeLamp:
    """A lamp anywhere, as drawn."""

    tilt_deg: float  # from the optical axis
    azimuth_deg: float  # about it, in the picture
    share: float  # of the light
    colour: tuple[float, float, float]  # linear RGB
    window_deg: float  # its angular radius at the tissue


@dataclass(frozen=True)
class Lighting:
    """Light of one sequence."""

    glare: float  # 0 few highlights to 1 many
    mirror_deg: float  # slope that mirrors the main lamp into the lens; unused with `tilt_deg`
    tilt_deg: float | None  # angle between main lamp and optical axis, if the job sets one
    azimuth_deg: float  # of the lamp, from the optical axis's tilt, or in the picture with `tilt_deg`
    main: float  # share of the light that comes from the main lamp
    power: float
    kelvin: float  # colour temperature
    even: float  # radius of the spot, in widths of the field: light falls by a third to there
    drift: float  # largest change of power over the sequence
    phase: float  # of the drift's slow wave in the rest frame [rad]
    ambient: float = 0.05  # share of the lamps' light that comes from all directions
    lamps: tuple[FreeLamp, ...] = ()  # instead of the microscope's

    def gain(self, part: float) -> float:
        """Power at a part (0 to 1) of the sequence, relative to the rest frame."""
        return 1 + self.drift * 0.5 * float(np.sin(self.phase + np.pi * part) - np.sin(self.phase))


def lamps(camera: Camera, lighting: Lighting) -> tuple[Lamp, ...]:
    """The lamps, which together give a white surface in the opening a radiance of about 1."""
    # Wide windows are behind the lens, which they would hide.
    distance = float(np.linalg.norm(camera.centre)) * (1.05 if lighting.lamps else 1.0)
    # Radiance of a white diffuser square to the light is I / (pi d^2); the opening is at an angle to it.
    total = lighting.power * np.pi * distance**2
    window = _WINDOW_DEG, blackbody(lighting.kelvin)
    sides = (lighting.main, 0), (1 - lighting.main, 1)
    beams = [
        (lamp.share, lamp.window_deg, np.array(lamp.colour), _free_direction(camera, lamp))
        for lamp in lighting.lamps
    ]
    beams = beams or [(share, *window, _lamp_direction(camera, lighting, side)) for share, side in sides]
    sources = []
    for share, window_deg, colour, direction in beams:
        intensity = share * total * colour / max(float(direction[2]), 0.3)
        radius = distance * float(np.tan(np.deg2rad(window_deg)))
        sources.append(Lamp(distance * direction, np.zeros(3), radius, intensity))
    return tuple(sources)


def mirror_slopes(camera: Camera, lamp: Lamp) -> tuple[float, float, float]:
    """Slopes dz/dx and dz/dy at the origin of a surface that mirrors a lamp into the lens, and by how much
    both rise with x and y [1/mm]."""
    distances = np.linalg.norm([camera.centre, lamp.position], axis=1)
    half_vector = camera.centre / distances[0] + lamp.position / distances[1]
    x, y = (-half_vector[:2] / half_vector[2]).tolist()
    return x, y, float((1 / distances).sum() / half_vector[2])


def spot(camera: Camera, rest: Camera, even: float) -> Map:
    """Share (H, W) of the lamps' light at each pixel of a camera, in the plane of the opening, which falls by
    a third to `even` widths of the field and on outside; fixed to the microscope's pose `rest`.

    The image of a lamp's field stop, out of focus: 1 / (1 + (r / h)^4), brighter than 1 in the middle, since
    its mean over a usual opening is 1. Infinite `even`: 1 everywhere.
    """
    width, height = camera.size
    if np.isinf(even):
        return np.ones((height, width), np.float32)
    field = rest.size[0] * rest.mm_per_px
    axis = rest.centre / np.linalg.norm(rest.centre)
    # A smooth field: a coarse grid of rays is enough.
    columns, rows = (np.linspace(0, n - 1, _RAYS) for n in (width, height))
    x, y = np.meshgrid((columns - camera.K[0, 2]) / camera.K[0, 0], (rows - camera.K[1, 2]) / camera.K[1, 1])
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ camera.rotation
    points = camera.centre - (camera.centre @ axis / (rays @ axis))[..., None] * rays
    half = even / _EDGE
    share = 1 / (1 + (np.linalg.norm(points, axis=-1) / (field * half)) ** 4)
    ratio = (_OPENING / half) ** 2
    share *= min(ratio / np.arctan(ratio), _BRIGHTEST)
    across, down = (np.linspace(0, _RAYS - 1, n, dtype=np.float32) for n in (width, height))
    share = cv2.remap(share.astype(np.float32), *np.meshgrid(across, down), cv2.INTER_LINEAR)
    return np.asarray(share, np.float32)


def _tilt_axis(camera: Camera, tilt: float, turn: float) -> Floats:
    """Unit direction (3,) at an angle to the optical axis, and about it in the picture [rad]."""
    axis, (right, down, _) = camera.centre / np.linalg.norm(camera.centre), camera.rotation
    return np.asarray(np.cos(tilt) * axis + np.sin(tilt) * (np.cos(turn) * right + np.sin(turn) * down))


def _free_direction(camera: Camera, lamp: FreeLamp) -> Floats:
    """Unit direction (3,) of a lamp, at least `_LOWEST` above the opening's plane."""
    direction = _tilt_axis(camera, *np.deg2rad([lamp.tilt_deg, lamp.azimuth_deg]))
    horizontal = direction[:2] * min(1.0, np.sqrt(1 - _LOWEST**2) / max(np.linalg.norm(direction[:2]), 1e-9))
    return np.append(horizontal, max(direction[2], _LOWEST))


def _lamp_direction(camera: Camera, lighting: Lighting, side: float) -> Floats:
    """Unit direction (3,) from the craniotomy to the main lamp (side 0) or to the one across the lens (1)."""
    axis = camera.centre / np.linalg.norm(camera.centre)
    turn = np.deg2rad(lighting.azimuth_deg) + side * _APART
    if lighting.tilt_deg is not None:
        return _tilt_axis(camera, np.deg2rad(lighting.tilt_deg), turn)
    turn = turn + np.arctan2(axis[1], axis[0])
    slope = np.deg2rad(lighting.mirror_deg)
    normal = np.array([np.sin(slope) * np.cos(turn), np.sin(slope) * np.sin(turn), np.cos(slope)])
    direction = 2 * (axis @ normal) * normal - axis
    tilt, steepest = np.arccos(np.clip(direction @ axis, -1, 1)), np.deg2rad(_STEEPEST_DEG)
    if tilt > steepest:
        across = direction - (direction @ axis) * axis
        direction = np.cos(steepest) * axis + np.sin(steepest) * across / np.linalg.norm(across)
    return np.asarray(direction)


def balance(kelvin: float) -> tuple[float, float, float]:
    """Gains of red, green, blue that make the light of a black body white."""
    gains = 1 / blackbody(kelvin)
    r, g, b = (gains / gains[1]).tolist()
    return r, g, b


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
