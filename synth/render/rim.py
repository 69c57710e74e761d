"""What frames the opening: the cut edge of the dura folded back over bone, and bloody tissue beyond it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from synth.render import noise
from synth.render.anatomy import Surface
from synth.render.look import Look
from synth.render.shape import Shape
from synth.render.texture import Coat, normals

Floats = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

_AROUND, _OUT = 320, 44
_WIDTH_MM = 26.0  # beyond the opening; the picture ends before


@dataclass(frozen=True)
class Rim:
    """The frame of the opening as a mesh."""

    vertices: Floats
    """(V, 3) mm, world axes."""
    faces: npt.NDArray[np.int32]
    uv: npt.NDArray[np.float32]
    extent_mm: float
    """Side of the square that uv spans."""
    edge: Floats
    """(A,) mm: radius of the opening's edge at even angles."""

    @property
    def shape(self) -> Shape:
        """For casting rays at it."""
        return Shape(self.vertices, self.faces)


def build(surface: Surface, radius_mm: float, look: Look) -> Rim:
    """The rim around an opening of `radius_mm` in the surface."""
    rng = np.random.default_rng([look.rim_seed, 0])
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    edge = radius_mm * _outline(rng, angle)
    out = _WIDTH_MM * np.linspace(0, 1, _OUT - 3) ** 1.7
    # From below the brain's surface up the cut edge, over it, and away.
    away = np.concatenate([[0.15, 0.02, 0.0], out + 0.12])
    up = np.concatenate([[-1.6, -0.2, 0.25], 0.42 + 1.9 * (1 - np.exp(-out / 2.6)) + 0.05 * out])
    radius = edge[:, None] + away[None]
    xy = np.stack([radius * np.cos(angle)[:, None], radius * np.sin(angle)[:, None]], axis=-1)
    extent = 2 * (radius_mm * 1.25 + _WIDTH_MM)
    folds = 0.5 * noise.band(rng, 256, extent, 4.5, 0.5) + 0.22 * noise.band(rng, 256, extent, 1.6, 0.5)
    height = _under(surface, xy.reshape(-1, 2)).reshape(radius.shape)
    lift = np.clip(away - 0.3, 0, 3.0) / 3.0
    z = height + up[None] + lift * noise.sample(folds, xy.reshape(-1, 2), extent).reshape(radius.shape)
    vertices = np.concatenate([xy, z[..., None]], axis=-1).reshape(-1, 3)
    return Rim(vertices, _faces(), (vertices[:, :2] / extent + 0.5).astype(np.float32), extent, edge)


def paint(rim: Rim, look: Look, pixels: int) -> Coat:
    """Dura, blood and what lies beyond, as maps over the rim's square."""
    rng = np.random.default_rng([look.rim_seed, 1])
    extent = rim.extent_mm
    axis = noise.centres(pixels, extent)
    x, y = np.meshgrid(axis, axis)
    angle = np.arctan2(y, x) % (2 * np.pi)
    closed = np.append(rim.edge, rim.edge[0])
    away = np.hypot(x, y) - np.interp(angle, np.linspace(0, 2 * np.pi, len(closed)), closed).astype(
        np.float32
    )
    wide = noise.fractal(rng, pixels, extent, 7.0, 2.2)
    mid = noise.fractal(rng, pixels, extent, 2.2, 2.5)
    fine = noise.fractal(rng, pixels, extent, 0.8, 2.0)
    dura = np.array([0.80, 0.52, 0.44], np.float32) * (1 + 0.06 * fine + 0.08 * mid)[..., None]
    flesh = np.array([0.52, 0.085, 0.05], np.float32) * (1 + 0.12 * mid + 0.03 * fine)[..., None]
    fat = np.array([0.70, 0.42, 0.20], np.float32) * (1 + 0.12 * fine)[..., None]
    reach = 2.6 + 1.1 * wide
    beyond = _step((away - reach) / 0.5 + 0.5 * mid)
    yellow = _step(wide * 1.5 - 1.2 + 0.4 * mid) * beyond
    beyond, yellow = beyond[..., None], yellow[..., None]
    colour = dura * (1 - beyond) + flesh * beyond
    colour = colour * (1 - 0.7 * yellow) + fat * 0.7 * yellow
    # Blood runs and gathers: thick where the noise says so and in the fold behind the flap.
    fold = np.exp(-(((away - reach) / 0.8) ** 2))
    gathered = 2.2 * look.blood - 1.5 + 0.7 * wide + 0.45 * mid + 0.04 * fine + 0.7 * fold
    blood = 0.06 + 0.3 * np.log1p(np.exp(3 * gathered))
    colour = colour * np.exp(-blood[..., None] * np.array([0.45, 3.4, 3.6], np.float32))
    colour = colour * (1 + 0.25 * np.exp(-((away / 0.3) ** 2)))[..., None]
    colour = np.clip(colour, 0.006, 0.92).astype(np.float32)
    bumps = 0.05 * mid + 0.008 * fine + 0.02 * noise.band(rng, pixels, extent, 1.2, 0.5)
    return Coat(colour, normals(noise.blur(bumps.astype(np.float32), 0.1, extent), extent))


def _outline(rng: np.random.Generator, angle: Floats) -> Floats:
    """An opening cut by hand: a rounded polygon about a circle."""
    shape = np.ones_like(angle)
    for order in range(2, 9):
        shape += rng.normal(0, 0.055 / order) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
    for order in range(12, 30):
        shape += rng.normal(0, 0.0007) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
    return shape


def _under(surface: Surface, xy: Floats) -> Floats:
    """Height of the smoothed surface below points; beyond the patch it goes on falling as at its border."""
    half = surface.extent_mm / 2
    inner = np.clip(xy, -half, half)
    _, near = cKDTree(surface.vertices[:, :2]).query(inner, k=16)
    height = surface.vertices[:, 2][near].mean(axis=1)
    # The patch's own dome, as the paraboloid through its heights.
    r2 = (surface.vertices[:, :2] ** 2).sum(axis=1)
    slope = float(
        np.linalg.lstsq(np.stack([r2, np.ones_like(r2)], 1), surface.vertices[:, 2], rcond=None)[0][0]
    )
    return np.asarray(height + slope * ((xy**2).sum(axis=1) - (inner**2).sum(axis=1)))


def _step(x: Map) -> Map:
    t = np.clip(x + 0.5, 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float32)


def _faces() -> npt.NDArray[np.int32]:
    row, column = np.meshgrid(np.arange(_AROUND), np.arange(_OUT - 1), indexing="ij")
    a = (row * _OUT + column).ravel()
    b = a + 1
    c = (((row + 1) % _AROUND) * _OUT + column).ravel()
    d = c + 1
    return np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32)
