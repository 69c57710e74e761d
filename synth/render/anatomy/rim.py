"""What frames the opening: the cut dura with its lip, blood on it, what lies beyond, and a cotton patty."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from synth.geometry.triangles import Shape
from synth.render.anatomy import noise
from synth.render.anatomy.surface import Surface
from synth.render.anatomy.texture import Coat, normals
from synth.render.appearance.look import Look

Floats = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

_AROUND, _OUT, _INNER = 320, 42, 6  # at most: points around, rings outwards, rings of the cut edge
_SEGMENT_PX = 4.0  # points around are no nearer than this in the picture: the mesh is built anew every frame
_WIDTH_MM = 26.0  # beyond the opening; the picture ends before
_LIP_MM = 0.3  # how far the cut edge reaches over the brain
_LAID_MM = (-3.0, -1.5, -1.2, -0.95, -0.7, -0.3)
_PATTY_MM = 0.55  # thickness of a cotton patty


@dataclass(frozen=True)
class Patty:
    """A strip of cotton on the rim."""

    middle: tuple[float, float]
    """World x, y [mm]."""
    turn: float
    """Direction of its long side [rad]."""
    half: tuple[float, float]
    """Half its length and width [mm]."""


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
    patty: Patty | None

    @property
    def shape(self) -> Shape:
        """For casting rays at it."""
        return Shape(self.vertices, self.faces)


def build(surface: Surface, radius_mm: float, look: Look, mm_per_px: float) -> Rim:
    """The rim around an opening of `radius_mm` in the surface, as fine as pixels of `mm_per_px` show."""
    rng = np.random.default_rng([look.rim_seed, 0])
    around = int(np.clip(2 * np.pi * radius_mm / (_SEGMENT_PX * mm_per_px), 96, _AROUND))
    rings = round(_OUT * around / _AROUND)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    edge = radius_mm * _outline(rng, angle)
    out = _WIDTH_MM * np.linspace(0, 1, rings) ** 1.6
    # The cut edge rises out of the brain's surface towards the lens, rounds, and goes on outwards.
    away = np.concatenate([-_LIP_MM * np.array([1.0, 0.97, 0.88, 0.7, 0.4, 0.1]), out + 0.12])
    up = np.concatenate(
        [[-1.8, -0.1, 0.12, 0.27, 0.39, 0.46], 0.5 + 1.5 * (1 - np.exp(-out / 3.5)) + 0.05 * out]
    )
    radius = edge[:, None] + away[None]
    xy = np.stack([radius * np.cos(angle)[:, None], radius * np.sin(angle)[:, None]], axis=-1)
    extent = 2 * (radius_mm * 1.25 + _WIDTH_MM)
    folds = 0.28 * noise.band(rng, 256, extent, 6.5, 0.5) + 0.05 * noise.band(rng, 256, extent, 1.8, 0.5)
    height = _under(surface, xy.reshape(-1, 2)).reshape(radius.shape)
    lift = np.clip(away - 0.1, 0, 3.0) / 3.0
    z = height + up[None] + lift * noise.sample(folds, xy.reshape(-1, 2), extent).reshape(radius.shape)
    patty = _patty(rng, edge) if look.cottonoid else None
    if patty:
        over = _step((0.3 - _outside(patty, xy[..., 0], xy[..., 1])) / 0.6)
        # Cotton lies over folds rather than in them.
        z = z + over * (_PATTY_MM + 0.3)
    vertices = np.concatenate([xy, z[..., None]], axis=-1).reshape(-1, 3)
    # The cut edge stands upright: on the maps it is laid flat inside the opening, or it had no width there.
    flat = edge[:, None] + np.concatenate([_LAID_MM, away[len(_LAID_MM) :]])[None]
    laid = np.stack([flat * np.cos(angle)[:, None], flat * np.sin(angle)[:, None]], axis=-1).reshape(-1, 2)
    return Rim(
        vertices,
        _faces(around, _INNER + rings),
        (laid / extent + 0.5).astype(np.float32),
        extent,
        edge,
        patty,
    )


def paint(rim: Rim, look: Look, pixels: int) -> Coat:
    """Dura, blood and what lies beyond, as maps over the rim's square."""
    rng = np.random.default_rng([look.rim_seed, 1])
    extent = rim.extent_mm
    wide = noise.fractal(rng, pixels, extent, 8.0, 2.6)
    mid = noise.fractal(rng, pixels, extent, 2.2, 2.3)
    fine = noise.fractal(rng, pixels, extent, 0.6, 1.6)
    across = noise.fractal(rng, 512, 512.0, 24.0, 1.2)
    swell = noise.band(rng, pixels, extent, 1.4, 0.5)
    axis = noise.centres(pixels, extent)
    x, y = np.broadcast_to(axis, (pixels, pixels)), np.broadcast_to(axis[:, None], (pixels, pixels))
    maps = [x, y, wide, mid, fine, swell]
    if rim.patty:
        ragged = noise.fractal(rng, pixels, 60.0, 1.5, 1.5)
        weave = noise.band(rng, pixels, 60.0, 0.5, 0.5)
        maps += [ragged, weave, noise.fractal(rng, pixels, 60.0, 4.0, 2.0)]
    colour, bumps, thin = noise.in_rows(partial(_paint_rows, rim, look, across), *maps)
    dry = cv2.resize(thin, (256, 256), interpolation=cv2.INTER_AREA)
    return Coat(
        colour, normals(noise.blur(bumps.astype(np.float32), 0.2, extent), extent), dry.astype(np.float32)
    )


def _paint_rows(
    rim: Rim,
    look: Look,
    across: Map,
    x: Map,
    y: Map,
    wide: Map,
    mid: Map,
    fine: Map,
    swell: Map,
    *cotton: Map,
) -> tuple[Map, Map, Map]:
    """Colour (r, n, 3), bumps mm and share without a film (r, n) of some rows at x, y mm, of noise (r, n)."""
    angle, away = _polar(rim, x, y)
    fibres = _streaks(across, angle, away, float(rim.edge.mean()))
    dura = np.asarray(look.dura, np.float32) * (1 + 0.05 * fibres + 0.05 * mid + 0.02 * fine)[..., None]
    beyond = np.asarray(look.beyond, np.float32) * (1 + 0.18 * mid + 0.04 * fine)[..., None]
    fat = np.array([0.72, 0.46, 0.22], np.float32) * (1 + 0.10 * fine)[..., None]
    reach = 4.8 + 1.6 * wide
    outer = _step((away - reach) / 1.0 + 0.2 * mid)
    yellow = (0.7 * _step(wide * 1.5 - 1.4 + 0.4 * mid) * outer)[..., None]
    colour = dura * (1 - outer[..., None]) + beyond * outer[..., None]
    colour = colour * (1 - yellow) + fat * yellow
    # Blood runs along the fibres and gathers: where the noise says so and in the fold behind the flap.
    fold = np.exp(-(((away - reach) / 1.3) ** 2))
    runs = 0.8 * wide + 0.25 * mid + 0.3 * fibres
    gathered = 2.4 * look.blood - 1.9 + runs + (0.3 + 1.2 * look.blood) * fold
    blood = (0.02 + 0.4 * np.log1p(np.exp(2.0 * gathered))) * min(1.0, 8 * look.blood)
    colour = colour * np.exp(-blood[..., None] * np.array([0.26, 2.4, 2.8], np.float32))
    # The lip is thin and pale; under it the light is lost.
    lip = np.exp(-(((away + 0.1) / 0.35) ** 2))[..., None]
    under = np.clip(-away - 0.9, 0, 1)[..., None]
    colour = colour * (1 + 0.12 * lip) * np.exp(-under * np.array([0.35, 0.9, 1.0], np.float32))
    bumps = 0.035 * mid + 0.006 * swell
    if rim.patty:
        colour, bumps = _cotton(cotton, rim.patty, colour, bumps, x, y, look.blood)
    colour = np.clip(colour, 0.006, 0.92).astype(np.float32)
    return colour, bumps, np.clip(0.55 + 0.3 * wide - 0.8 * blood, 0.02, 1)


def shade(rim: Rim, extent_mm: float) -> Map:
    """Share (512, 512) of light that reaches the surface's patch of that extent past the lip."""
    axis = noise.centres(512, extent_mm)
    x, y = np.meshgrid(axis, axis)
    inside = np.maximum(_edge_at(rim, np.arctan2(y, x)) - _LIP_MM - np.hypot(x, y), 0)
    return np.asarray(1 - 0.35 * np.exp(-inside / 0.6) - 0.14 * np.exp(-inside / 2.0), np.float32)


def _polar(rim: Rim, x: Map, y: Map) -> tuple[Map, Map]:
    angle = np.arctan2(y, x)
    return angle, (np.hypot(x, y) - _edge_at(rim, angle)).astype(np.float32)


def _edge_at(rim: Rim, angle: Map) -> Map:
    closed = np.append(rim.edge, rim.edge[0])
    around = np.linspace(0, 2 * np.pi, len(closed))
    return np.asarray(np.interp(angle % (2 * np.pi), around, closed), np.float32)


def _streaks(across: Map, angle: Map, away: Map, radius: float) -> Map:
    """Fibres that run outwards with the folded flap: noise (512, 512) drawn long in one direction."""
    u = (angle / (2 * np.pi) % 1.0 * 512).astype(np.float32)
    v = (np.clip(away, 0, None) * 2.2 * 512 / (2 * np.pi * radius) % 512).astype(np.float32)
    return np.asarray(cv2.remap(across, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32)


def _patty(rng: np.random.Generator, edge: Floats) -> Patty:
    around = float(rng.uniform(0, 2 * np.pi))
    half = (float(rng.uniform(4.0, 8.0)), float(rng.uniform(2.0, 3.2)))
    radius = (
        float(edge[int(around / (2 * np.pi) * len(edge)) % len(edge)])
        + half[1]
        + float(rng.uniform(0.5, 2.0))
    )
    turn = around + np.pi / 2 + float(rng.uniform(-0.35, 0.35))
    return Patty((radius * float(np.cos(around)), radius * float(np.sin(around))), turn, half)


def _outside(patty: Patty, x: Floats | Map, y: Floats | Map) -> Map:
    """Distance to the patty's outline, negative inside [mm]."""
    c, s = np.cos(patty.turn), np.sin(patty.turn)
    dx, dy = x - patty.middle[0], y - patty.middle[1]
    far = np.maximum(np.abs(c * dx + s * dy) - patty.half[0], np.abs(c * dy - s * dx) - patty.half[1])
    return np.asarray(far, np.float32)


def _cotton(
    drawn: tuple[Map, ...], patty: Patty, colour: Map, bumps: Map, x: Map, y: Map, blood: float
) -> tuple[Map, Map]:
    """White felt with a blue thread, a little soaked at its edges."""
    ragged, weave, stains = drawn
    far = _outside(patty, x, y) + 0.12 * ragged
    cover = _step(0.5 - far / 0.25)[..., None]
    felt = np.array([0.86, 0.82, 0.76], np.float32) * (1 + 0.06 * weave)[..., None]
    soaked = blood * np.clip(1.2 + far / 1.2 + 0.5 * stains, 0, 1.5)
    felt = felt * np.exp(-soaked[..., None] * np.array([0.15, 1.3, 1.4], np.float32))
    c, s = np.cos(patty.turn), np.sin(patty.turn)
    along, across = (
        c * (x - patty.middle[0]) + s * (y - patty.middle[1]),
        c * (y - patty.middle[1]) - s * (x - patty.middle[0]),
    )
    thread = (np.exp(-((across / 0.25) ** 4)) * (along > -patty.half[0] + 1))[..., None]
    felt = felt * (1 - 0.8 * thread) + np.array([0.05, 0.12, 0.30], np.float32) * 0.8 * thread
    near = np.exp(-np.maximum(far, 0) / 0.5)[..., None]
    shaded = colour * (1 - 0.4 * near * (1 - cover))
    rough = bumps * (1 - cover[..., 0]) + 0.03 * weave * cover[..., 0]
    return np.asarray(shaded * (1 - cover) + felt * cover, np.float32), np.asarray(rough, np.float32)


def _outline(rng: np.random.Generator, angle: Floats) -> Floats:
    """An opening cut by hand and held by a few stitches: between a circle and a rounded polygon."""
    corners = int(rng.integers(5, 8))
    step = 2 * np.pi / corners
    phase = (angle + rng.uniform(0, step)) % step - step / 2
    polygon = np.cos(step / 2) / np.cos(phase)
    shape = 0.65 + 0.35 * polygon / polygon.mean()
    for order in range(2, 9):
        shape += rng.normal(0, 0.045 / order) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
    for order in range(12, 40):
        shape += rng.normal(0, 0.0010) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
    return np.asarray(shape)


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


def _step(x: Map | Floats) -> Map:
    t = np.clip(x + 0.5, 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float32)


def _faces(around: int, rings: int) -> npt.NDArray[np.int32]:
    row, column = np.meshgrid(np.arange(around), np.arange(rings - 1), indexing="ij")
    a = (row * rings + column).ravel()
    b = a + 1
    c = (((row + 1) % around) * rings + column).ravel()
    d = c + 1
    return np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32)
