"""Reflections in polished steel: of the wound, a dark theatre with its lamps, the microscope's windows.

They are evaluated at vertices, blurred by the finish: a path tracer's reflection of small bright lamps is
noise at few paths a pixel, and the theatre lights nothing else. Reflectances and the theatre's radiances (1:
white that fills the sensor) were chosen by eye; no instrument or theatre was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from synth.arrays import Floats, Map
from synth.geometry.triangles import Shape, normals
from synth.render.materials import Lamp

_STEEL, _BLACK = 0.58, 0.045
"""Reflectance at right angles of machined steel and of the coating."""
_SATIN = 0.10  # share of light that steel's finish scatters diffusely
_TINT = np.array([1.0, 0.985, 0.96])
_DRAPE, _CEILING = np.array([0.02, 0.045, 0.055]), np.array([0.16, 0.17, 0.18])
_LAMPS = 7
_FINISH = 0.30  # GGX alpha of machined steel
_FADE_MM = 22.0  # distance from the opening's middle at which drapes begin


@dataclass(frozen=True)
class Theatre:
    """Surroundings that the instruments reflect."""

    wound: Map  # (n, n, 3) linear colour of cortex and rim, from above
    extent_mm: float  # side of the square that it covers
    lamps: tuple[Lamp, ...]  # of the microscope
    light: Floats  # (3,) colour and power of the light on wound and theatre; 1 is white that fills the sensor
    lens: Floats  # (3,) mm, towards which steel mirrors them
    seed: int  # of the theatre's lamps


def tint(coat: npt.NDArray[np.floating]) -> Floats:
    """Diffuse reflectance (V, 3) of steel under a black `coat` (V,) 0 to 1."""
    bare, black = _SATIN * _STEEL * _TINT, np.full(3, 0.03)
    return np.asarray(bare + coat[:, None] * (black - bare))


def glow(steel: Shape, coat: npt.NDArray[np.floating], theatre: Theatre) -> Floats:
    """Radiance (V, 3) that steel, `coat` (V,) 0 bare to 1 black, mirrors towards the theatre's lens."""
    normal = normals(steel)
    towards = theatre.lens - steel.vertices
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    facing = np.einsum("nc,nc->n", normal, towards)[:, None]
    mirrored = 2 * facing * normal - towards
    straight = _STEEL * _TINT + coat[:, None] * (_BLACK - _STEEL * _TINT)
    # Schlick, An inexpensive BRDF model for physically-based rendering, 1994.
    share = straight + (1 - straight) * np.clip(1 - facing, 0, 1) ** 5
    mirror = _surroundings(steel.vertices, mirrored, theatre) * theatre.light
    for lamp in theatre.lamps:
        mirror += _window(steel.vertices, normal, towards, lamp)
    return np.asarray(share * mirror)


def _surroundings(place: Floats, direction: Floats, theatre: Theatre) -> Floats:
    """Radiance (N, 3) that arrives at places (N, 3) mm from directions (N, 3)."""
    up = direction[:, 2:]
    below = 1 / (1 + np.exp((up + 0.05) / 0.09))
    # Intersection of the mirrored ray with the wound's plane; nearly level ones meet drapes.
    steep = np.maximum(-direction[:, 2], 0.05)
    far = np.maximum(place[:, 2], 0.0) / steep
    met = place[:, :2] + far[:, None] * direction[:, :2]
    pixel = ((met / theatre.extent_mm + 0.5) * len(theatre.wound) - 0.5).T[::-1]
    planes = np.moveaxis(theatre.wound, -1, 0)
    wound = np.stack([map_coordinates(one, pixel, order=1, mode="nearest") for one in planes], axis=-1)
    lit = 1 / (1 + np.exp(np.clip((np.linalg.norm(met, axis=1) - _FADE_MM) / 3.0, -40, 40)))[:, None]
    ground = lit * 0.8 * wound + (1 - lit) * _DRAPE
    high = np.clip(up, 0, 1) ** 0.5
    above = (1 - high) * _DRAPE + high * _CEILING
    return np.asarray(below * ground + (1 - below) * (above + _ceiling_lamps(direction, theatre.seed)))


def _ceiling_lamps(direction: Floats, seed: int) -> Floats:
    """Radiance (N, 1) of the theatre's lamps."""
    rng = np.random.default_rng([seed, 3])
    total = np.zeros((len(direction), 1))
    ranges = (0.0, 2 * np.pi), (0.05, 0.8), (0.10, 0.28), (0.6, 2.6)
    drawn = [rng.uniform(*ends, _LAMPS) for ends in ranges]
    for azimuth, height, size, power in zip(*drawn, strict=True):
        flat = np.sqrt(1 - height**2)
        middle = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), height])
        total += power * np.exp(-np.maximum(1 - direction @ middle, 0) / (0.5 * size**2))[:, None]
    return total


def _window(place: Floats, normal: Floats, towards: Floats, lamp: Lamp) -> Floats:
    """Reflection (N, 3) of a microscope's window in a machined finish, by a GGX lobe."""
    way = lamp.position - place
    away2 = np.einsum("nc,nc->n", way, way)
    way /= np.sqrt(away2)[:, None]
    half = way + towards
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    in_line = np.clip(np.einsum("nc,nc->n", normal, half), 0, 1) ** 2
    lobe = _FINISH**2 / (np.pi * (in_line * (_FINISH**2 - 1) + 1) ** 2)
    lit = np.einsum("nc,nc->n", normal, way) > 0
    return np.asarray((lit * lobe / (4 * away2))[:, None] * lamp.intensity)
