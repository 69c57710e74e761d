"""Surroundings that instruments mirror: the wound, drapes, a dark theatre. The lamps are the renderer's.

They are evaluated at vertices, blurred by the roughness there, and shaded by the maps at every hit: paths to
them would be noise at few a pixel, and they light nothing else. The theatre's radiances (1: white that fills
the sensor) were chosen by eye; no theatre was measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from synth.arrays import Floats, Map
from synth.geometry.triangles import Shape, normals

_DRAPE, _CEILING = np.array([0.02, 0.045, 0.055]), np.array([0.30, 0.31, 0.33])
_PANELS = (0.4, 1.7, 2.9, 4.2, 5.3), 0.2, 1.5  # windows and light boxes: azimuths, half width [rad], radiance
_FADE_MM = 22.0  # distance from the opening's middle at which drapes begin
_BLURRED_MM = 0.0, 1.0, 2.0, 4.0, 8.0, 16.0  # standard deviations of the blurred wounds
_SPREAD = 1.7  # standard deviation of a reflected direction [rad] by the GGX alpha, as of its median
_SHADED = 0.8  # share of the wound's radiance: an instrument mirrors tissue in its own shadow,
_DARKER = 0.65, 3.5  # of that share, what is lost where it touches, and the height over which less is, mm
_GRAZING = 5.0, 0.4  # rise of the reflectance of plastic and steel at grazing angles, less by roughness
_TWICE = 1.25  # where light arrives that tissue has scattered before: a power of its colour


@dataclass(frozen=True)
class Theatre:
    """Surroundings that the instruments reflect."""

    wound: Map  # (n, n, 3) linear colour of cortex and rim, from above
    extent_mm: float  # side of the square that it covers
    light: Floats  # (3,) colour and power of the light on wound and theatre; 1 is white that fills the sensor
    lens: Floats  # (3,) mm, towards which steel mirrors them

    @cached_property
    def blurred(self) -> Floats:
        """The wound (3, levels, n, n) blurred by `_BLURRED_MM`."""
        per_mm = len(self.wound) / self.extent_mm
        planes = np.moveaxis(self.wound.astype(np.float64), -1, 0)
        spread = [
            gaussian_filter(planes, (0, mm * per_mm, mm * per_mm), mode="nearest") for mm in _BLURRED_MM
        ]
        return np.stack(spread, axis=1)


def glow(shape: Shape, alpha: Floats, bare: Floats, theatre: Theatre) -> Floats:
    """Radiance (V, 3) of the theatre, but for lamps, that mirrors at a shape's vertices show its lens.

    `alpha`: (V,) GGX roughness of the mirrors; `bare`: (V,) share of them that is metal, else plastic.
    """
    normal = normals(shape)
    view = theatre.lens - shape.vertices
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    cosines = np.einsum("nc,nc->n", normal, view)[:, None]
    radiance = _surroundings(shape.vertices, 2 * cosines * normal - view, alpha, theatre) * theatre.light
    rise = np.interp(bare, (0, 1), _GRAZING)[:, None]
    return np.asarray(radiance * (1 + rise * np.clip(1 - cosines, 0, 1) ** 5))  # C. Schlick, 1994


def _surroundings(place: Floats, direction: Floats, alpha: Floats, theatre: Theatre) -> Floats:
    """Radiance (N, 3) that arrives at places (N, 3) mm from around directions (N, 3)."""
    up, spread = direction[:, 2:], _SPREAD * alpha
    downward_share = 1 / (1 + np.exp(np.clip((up + 0.05) / np.hypot(0.09, alpha)[:, None], -40, 40)))
    # Intersection of the mirrored ray with the wound's plane; nearly level ones meet drapes.
    range_mm = np.maximum(place[:, 2], 0.0) / np.maximum(-direction[:, 2], 0.05 + 0.5 * spread)
    points, width = place[:, :2] + range_mm[:, None] * direction[:, :2], range_mm * spread
    row, column = ((points / theatre.extent_mm + 0.5) * len(theatre.wound) - 0.5).T[::-1]
    coordinates = np.stack([np.interp(width, _BLURRED_MM, np.arange(len(_BLURRED_MM))), row, column])
    wound = np.stack(
        [map_coordinates(plane, coordinates, order=1, mode="nearest") for plane in theatre.blurred], axis=-1
    )
    edge = (np.linalg.norm(points, axis=1) - _FADE_MM) / (3.0 + 0.6 * width)
    lit_share = 1 / (1 + np.exp(np.clip(edge, -40, 40)))[:, None]
    loss, height = _DARKER
    shade = _SHADED * (1 - loss * np.exp(-np.maximum(place[:, 2:], 0.0) / height))
    ground = lit_share * shade * wound**_TWICE + (1 - lit_share) * _DRAPE
    elevation = np.clip(up, 0, 1)
    sky = (1 - elevation) * _DRAPE + elevation * _CEILING + _panels(direction, spread)[:, None]
    return np.asarray(downward_share * ground + (1 - downward_share) * sky)


def _panels(direction: Floats, spread: Floats) -> Floats:
    """Radiance (N,) of light boxes on walls around directions (N, 3) of a standard deviation (N,) rad."""
    turns, half, radiance = _PANELS
    width = np.hypot(half, spread)
    angles = np.arctan2(direction[:, 1], direction[:, 0]) - np.array(turns)[:, None]
    profile = np.exp(-((np.angle(np.exp(1j * angles)) / width) ** 2)).sum(axis=0) * half / width
    return np.asarray(radiance * profile * np.exp(-(((direction[:, 2] - 0.3) / np.hypot(0.4, spread)) ** 2)))
