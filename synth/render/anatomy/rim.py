"""What frames the opening: cut dura with vessels and stitches, blood on it, what lies beyond, cotton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from synth.geometry.triangles import Shape, grid_faces, joined
from synth.render.anatomy import noise, scenery, tube
from synth.render.anatomy.surface import CortexSurface
from synth.render.anatomy.texture import normals
from synth.render.appearance.look import Look
from synth.render.mitsuba.adapter import Coat

Floats = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

_AROUND, _OUT, _INNER = 320, 42, 6  # at most: points around, rings outwards, rings of the cut edge
_SEGMENT_PX = 4.0  # points around are no nearer than this in the picture: the mesh is built anew every frame
_WIDTH_MM = 26.0  # beyond the opening; the picture ends before
_LIP_MM = 0.5  # how far the cut edge reaches over the brain
_LAID_MM = (-3.0, -1.5, -1.2, -0.95, -0.7, -0.3)
_PATTY_MM = 0.55  # thickness of a cotton patty
_THREAD_MM = 0.075  # half width of a stitch's thread
_GUTTER_MM, _STEPS_MM = 1.3, (1.5, 0.8)  # height of the wound's floor, and of each step of its wall


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

    shape: Shape
    uv: npt.NDArray[np.float32]
    """(V, 2)."""
    extent_mm: float
    """Side of the square that uv spans."""
    edge: Floats
    """(A,) mm: radius of the opening's edge at even angles."""
    cotton: tuple[Patty, ...]
    """What the maps show of it; the patties over the opening's edge take theirs from one in the middle."""
    stitches: Floats
    """(n,) rad: where threads hold the dura."""
    dura: Floats
    """(A,) mm beyond the edge where the folded dura ends, and the gutter behind it begins."""
    wall: Floats
    """(A,) mm beyond the edge where the wound's wall rises, to bone or muscle."""
    bone: bool
    cloth: Floats
    """(A,) mm beyond the edge where drapes begin; empty: there are none in view."""


def build(surface: CortexSurface, radius_mm: float, look: Look, mm_per_px: float) -> Rim:
    """The rim around an opening of `radius_mm` in the surface, as fine as pixels of `mm_per_px` show."""
    rng = np.random.default_rng([look.rim_seed, 0])
    around = int(np.clip(2 * np.pi * radius_mm / (_SEGMENT_PX * mm_per_px), 96, _AROUND))
    rings = round(_OUT * around / _AROUND)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    edge = radius_mm * _outline(rng, angle)
    out = _WIDTH_MM * (0.4 * np.linspace(0, 1, rings) + 0.6 * np.linspace(0, 1, rings) ** 3)
    # The cut edge rises out of the brain's surface towards the lens, rounds, and goes on outwards.
    away = np.concatenate([-_LIP_MM * np.array([1.0, 0.96, 0.72, 0.44, 0.2, 0.04]), out + 0.12])
    up = np.concatenate([[-1.8, -0.12, 0.10, 0.26, 0.38, 0.46], 0.5 + 0.05 * out])
    away = np.broadcast_to(away, (around, len(away)))
    radius = edge[:, None] + away
    xy = np.stack([radius * np.cos(angle)[:, None], radius * np.sin(angle)[:, None]], axis=-1)
    extent = 2 * (radius_mm * 1.25 + _WIDTH_MM)
    folds = 0.2 * noise.band(rng, 256, extent, 6.5, 0.5) + 0.05 * noise.band(rng, 256, extent, 1.8, 0.5)
    flat = xy.reshape(-1, 2)
    z = _under(surface, flat).reshape(radius.shape) + up
    z += np.clip(away - 0.1, 0, 3.0) / 3.0 * noise.sample(folds, flat, extent).reshape(radius.shape)
    patty = _patty(rng, edge) if look.cottonoid else None
    held = scenery.stitches(edge, rng)[: 0 if look.family == "calf" else None]  # on the bench nobody sews
    asides = [_aside(angle, stitch)[:, None] * float(edge.mean()) for stitch in held]
    dura = _ragged(rng, angle, 3.1, 0.7) + sum(1.3 * np.exp(-((aside[:, 0] / 1.6) ** 2)) for aside in asides)
    wall = dura + _ragged(rng, angle, 1.7, 0.6)
    cloth = wall + _ragged(rng, angle, 3.0, 0.8) if "drape" in look.scenery else np.zeros(0)
    z += _folded(away, dura[:, None], _ragged(rng, angle, 3.0, 1.2)[:, None], asides)
    steps, bone = (wall + 0.4, wall + _ragged(rng, angle, 2.4, 0.7)), "bone" in look.scenery
    risen = sum(high * _step((away - at[:, None]) / 0.7) for at, high in zip(steps, _STEPS_MM, strict=True))
    lumps = noise.sample(noise.band(rng, 256, extent, 2.6, 0.6), flat, extent).reshape(radius.shape)
    floor = _GUTTER_MM - 0.5 + risen + (0.12 if bone else 0.4) * np.minimum(risen, 1) * lumps
    z += _step((away - dura[:, None]) / 0.35 - 0.4) * floor  # a gutter, and steps of bone or lumpy muscle
    if len(cloth):
        z += _step((away - cloth[:, None]) / 1.2 - 0.5) * (1.0 + 0.7 * lumps)
    if patty:
        over = _step((0.3 - _placed(patty, xy[..., 0], xy[..., 1])[2]) / 0.6)
        z += over * (_PATTY_MM + 0.3)  # cotton lies over folds rather than in them
    vertices = np.concatenate([xy, z[..., None]], axis=-1).reshape(-1, 3)
    # The cut edge is steep: on the maps it is laid flat inside the opening, or it had hardly a width there.
    flat = edge[:, None] + np.concatenate([_LAID_MM, away[0, len(_LAID_MM) :]])[None]
    laid = np.stack([flat * np.cos(angle)[:, None], flat * np.sin(angle)[:, None]], axis=-1).reshape(-1, 2)
    felt: tuple[Patty, ...] = () if patty is None else (patty,)
    parts = [(vertices, grid_faces(around, _INNER + rings, "rows").reshape(-1, 3), laid)]
    if "cottonoid" in look.scenery:
        # Their felt is painted in the middle of the maps, where the opening is.
        felt += (Patty((0.0, 0.0), 0.0, scenery.PATTY_MM),)
        parts += scenery.patties(edge, np.concatenate([surface.vertices, vertices]), rng)
    uv = (np.concatenate([place for *_, place in parts]) / extent + 0.5).astype(np.float32)
    mesh = joined(*(Shape(vertices, faces) for vertices, faces, _ in parts))
    return Rim(mesh, uv, extent, edge, felt, held, dura, wall, bone, cloth)


def _folded(away: Floats, dura: Floats, sway: Floats, asides: list[Floats]) -> Floats:
    """Height (A, R) mm of the turned-over dura: rolled edge, pleats, the tents of stitches, a free end.

    `away`: mm from the edge; `dura`: where it ends; `sway`: how pleats wander; `asides`: mm from each stitch.
    """
    raised = 0.11 * sway * np.exp(-(((away - 0.8) / 0.5) ** 2))
    raised += 0.2 * np.sin(3.2 * away + 2 * sway) * np.clip(away - 0.8, 0, 1)
    # It leans against the wall: its free end is the highest, and curls.
    raised += 0.36 * np.clip(away, 0, None) + 0.35 * np.exp(-(((away - dura + 0.3) / 0.28) ** 2))
    for aside in asides:
        raised += 0.2 * np.cos(aside * 3.6) * np.exp(-((aside / 2.4) ** 2)) * np.clip(away / 1.5, 0, 1)
        raised += 0.55 * np.exp(-((aside / 1.2) ** 2) - ((away - 1.0) / 1.3) ** 2)
    return np.asarray(np.where(away > 0, raised, 0.0) * (1 - _step((away - dura) / 0.35 - 0.4)))


def _aside(angle: npt.NDArray[Any], stitch: float) -> npt.NDArray[Any]:
    """Angle (...) from a stitch, to the shorter side [rad]."""
    return np.mod(angle - stitch + np.pi, 2 * np.pi) - np.pi


def _ragged(rng: np.random.Generator, angle: Floats, mean: float, spread: float) -> Floats:
    """A distance (A,) mm that wanders round the opening."""
    wave = np.full_like(angle, mean)
    for order in range(2, 14):
        wave += rng.normal(0, spread / order**0.7) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
    return np.maximum(wave, 0.35 * mean)


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
    vessels = tube.raster(scenery.dural_vessels(rim.edge, rng), pixels, extent)
    maps = [x, y, wide, mid, fine, swell, *vessels]
    if rim.cotton:
        ragged = noise.fractal(rng, pixels, 60.0, 1.5, 1.5)
        weave = noise.band(rng, pixels, 60.0, 0.5, 0.5)
        maps += [ragged, weave, noise.fractal(rng, pixels, 60.0, 4.0, 2.0)]
    colour, bumps, thin = noise.in_rows(partial(_paint_rows, rim, look, across), *maps)
    dry = cv2.resize(thin, (256, 256), interpolation=cv2.INTER_AREA)
    bent = normals(noise.blur(bumps.astype(np.float32), 0.2, extent), extent)
    return Coat(colour, bent, dry.astype(np.float32))


def _paint_rows(rim: Rim, look: Look, across: Map, *maps: Map) -> tuple[Map, Map, Map]:
    """Colour (r, n, 3), bumps mm and share without a film (r, n) of some rows at x, y mm, of noise (r, n)."""
    x, y, wide, mid, fine, swell, distance, radius, *cotton = maps
    angle = np.arctan2(y, x)
    away = (np.hypot(x, y) - _round(rim.edge, angle)).astype(np.float32)
    fibres = _streaks(across, angle, away, float(rim.edge.mean()))
    dura = np.asarray(look.dura, np.float32) * (1 + 0.05 * fibres + 0.05 * mid + 0.02 * fine)[..., None]
    # Its own vessels shimmer through its outer layer.
    chord = 2 * np.sqrt(np.maximum(radius**2 - distance**2, 0))
    flush = 0.35 * np.exp(-np.maximum(distance - radius, 0) / 0.25) * np.clip(radius / 0.2, 0, 1)
    dura = dura * np.exp(-(4.5 * chord + flush)[..., None] * np.array([0.35, 1.0, 0.95], np.float32))
    beyond = np.asarray(look.beyond, np.float32) * (1 + 0.18 * mid + 0.04 * fine)[..., None]
    fat = np.array([0.72, 0.46, 0.22], np.float32) * (1 + 0.10 * fine)[..., None]
    reach = _round(rim.dura, angle)
    past = away - _round(rim.wall, angle)
    bumps = 0.035 * mid + 0.006 * swell
    # What was cut shows its strands, and pale fascia at the edge of each step.
    fascia = 0.45 * np.exp(-(((past - 1.0 - 0.3 * mid) / 0.3) ** 2))[..., None]
    beyond = np.asarray(beyond * (1 - fascia) + np.asarray(look.dura) * fascia, np.float32)
    if rim.bone:
        beyond = _bone(beyond, past, mid, fine)
        bumps *= np.where(past > 0.6, 0.4, 1.0).astype(np.float32)
    outer = _step((away - reach) / 0.3 + 0.2 * mid)
    yellow = (0.7 * _step(wide * 1.5 - 1.4 + 0.4 * mid) * _step(past))[..., None] * (not rim.bone)
    colour = dura * (1 - outer[..., None]) + beyond * outer[..., None]
    colour = colour * (1 - yellow) + fat * yellow
    # Blood runs along the fibres and gathers: where the noise says so, and in the gutter.
    gutter = outer * (1 - _step(past / 0.9 + 0.25 * mid))
    runs = 0.8 * wide + 0.25 * mid + 0.3 * fibres
    gathered = 2.4 * look.blood - 1.9 + runs + (0.3 + 2.6 * look.blood) * gutter
    blood = (0.02 + 0.4 * np.log1p(np.exp(2.0 * gathered))) * min(1.0, 8 * look.blood)
    colour = colour * np.exp(-blood[..., None] * np.array([0.26, 2.4, 2.8], np.float32))
    # The lip is thin and pale; under it the light is lost.
    lip = np.exp(-(((away + 0.1) / 0.35) ** 2))[..., None]
    under = np.clip(-away - 1.5, 0, 1)[..., None]
    colour = colour * (1 + 0.12 * lip) * np.exp(-under * np.array([0.35, 0.9, 1.0], np.float32))
    # Little light comes back out of the gutter, least from under the dura's free edge and at the wall's foot.
    crevice = np.minimum(np.abs(away - reach - 0.25), np.abs(past) + 0.1)
    lost = (0.7 * gutter + 0.8 * np.exp(-((crevice / 0.3) ** 2)))[..., None]
    colour = colour * np.exp(-lost * np.array([0.8, 1.1, 1.1], np.float32))
    dry = np.clip(0.55 + 0.3 * wide - 0.8 * blood - 0.5 * gutter, 0.02, 1)
    if len(rim.cloth):
        colour, bumps, dry = _draped(look, away - _round(rim.cloth, angle), mid, fine, colour, bumps, dry)
    threads = _threads(rim, angle, away)
    colour = colour + threads[..., None] * (np.array([0.025, 0.025, 0.035], np.float32) - colour)
    bumps = bumps + np.float32(0.08) * threads
    for patty in rim.cotton:
        colour, bumps = _cotton(cotton, patty, colour, bumps, x, y, look.blood)
    colour = np.clip(colour, 0.006, 0.92).astype(np.float32)
    return colour, np.asarray(bumps, np.float32), np.asarray(dry, np.float32)


def _bone(beyond: Map, past: Map, mid: Map, fine: Map) -> Map:
    """Colours with bone over its first millimetres: spongy where it is cut, ivory on top, bled on."""
    ivory = np.array([0.82, 0.71, 0.54], np.float32) * (1 + 0.06 * mid + 0.03 * fine)[..., None]
    ivory = ivory * np.exp(-np.clip(0.7 * mid - 0.5, 0, 2)[..., None] * np.array([0.2, 1.2, 1.4], np.float32))
    spongy = np.array([0.62, 0.30, 0.22], np.float32) * (1 + 0.25 * fine)[..., None]
    cut = 0.6 * np.exp(-(((past - 0.35) / 0.25) ** 2))[..., None]
    bone = ivory * (1 - cut) + spongy * cut
    top = _step((3.9 + 0.5 * mid - past) / 0.6)[..., None]
    return np.asarray(bone * top + beyond * (1 - top), np.float32)


def _draped(
    look: Look, past: Map, mid: Map, fine: Map, colour: Map, bumps: Map, dry: Map
) -> tuple[Map, Map, Map]:
    """Colour, bumps and dryness with blue or green cloth `past` mm beyond its border, bled on there."""
    dye = ((0.07, 0.20, 0.42), (0.06, 0.28, 0.26))[look.rim_seed % 2]
    cloth = np.asarray(dye, np.float32) * (1 + 0.10 * fine + 0.05 * mid)[..., None]
    bled = np.clip(look.blood * (1.1 - past / 2.0) + 0.3 * mid, 0, 1.2)[..., None]
    cloth = cloth * (1 - 0.6 * np.minimum(bled, 1)) + np.array([0.22, 0.02, 0.02], np.float32) * 0.6 * bled
    cover = _step(past / 0.3 - 0.5)
    colour = np.asarray(colour + (cloth - colour) * cover[..., None], np.float32)
    return colour, np.asarray(bumps * (1 - cover) + 0.012 * fine * cover, np.float32), np.maximum(dry, cover)


def _threads(rim: Rim, angle: Map, away: Map) -> Map:
    """Share covered by the stitches' threads: two strands from each, meeting far out."""
    covered = np.zeros_like(away)
    for stitch in rim.stitches:
        aside = _aside(angle, stitch) * (float(rim.edge.mean()) + away)
        # A loop that is round where it goes through, drawn together far out.
        apart = 0.42 * np.sqrt(np.clip((away - 0.9) / 0.7, 0, 1)) * np.clip(1 - (away - 1.0) / 12.0, 0, 1)
        line = np.where(away > 0.9, np.abs(np.abs(aside) - apart), 9.0)
        covered = np.maximum(covered, _step((_THREAD_MM - line) / 0.06 + 0.2))
    return np.asarray(covered, np.float32)


def shade(rim: Rim, surface: CortexSurface) -> Map:
    """Share (512, 512) of light that reaches the surface past the lip, over its chart."""
    x, y = surface.chart.places(512).T.reshape(2, 512, 512)
    inside = np.maximum(_round(rim.edge, np.arctan2(y, x)) - _LIP_MM - np.hypot(x, y), 0)
    return np.asarray(1 - 0.35 * np.exp(-inside / 0.6) - 0.14 * np.exp(-inside / 2.0), np.float32)


def inside(rim: Rim, x: Map, y: Map) -> Map:
    """Share of the opening at x, y mm (...): 1 in it, 0 under the rim, soft over a millimetre."""
    return _step((_round(rim.edge, np.arctan2(y, x)) - np.hypot(x, y)) / 1.0)


def _round(values: Floats, angle: Map) -> Map:
    """Values (A,) at even angles, at other angles."""
    closed = np.append(values, values[0])
    even = np.linspace(0, 2 * np.pi, len(closed))
    return np.asarray(np.interp(angle % (2 * np.pi), even, closed), np.float32)


def _streaks(across: Map, angle: Map, away: Map, radius: float) -> Map:
    """Fibres that run outwards with the folded flap: noise (512, 512) drawn long in one direction."""
    u = (angle / (2 * np.pi) % 1.0 * 512).astype(np.float32)
    v = (np.clip(away, 0, None) * 2.2 * 512 / (2 * np.pi * radius) % 512).astype(np.float32)
    return np.asarray(cv2.remap(across, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32)


def _patty(rng: np.random.Generator, edge: Floats) -> Patty:
    around = float(rng.uniform(0, 2 * np.pi))
    half = (float(rng.uniform(4.0, 8.0)), float(rng.uniform(2.0, 3.2)))
    radius = scenery.edge_at(edge, around) + half[1] + float(rng.uniform(0.5, 2.0))
    turn = around + np.pi / 2 + float(rng.uniform(-0.35, 0.35))
    return Patty((radius * float(np.cos(around)), radius * float(np.sin(around))), turn, half)


def _placed(patty: Patty, x: Floats | Map, y: Floats | Map) -> tuple[Floats, Floats, Map]:
    """Places x, y mm along a patty's length, across it, and from its outline, negative inside [mm]."""
    c, s = np.cos(patty.turn), np.sin(patty.turn)
    dx, dy = x - patty.middle[0], y - patty.middle[1]
    along, across = c * dx + s * dy, c * dy - s * dx
    far = np.maximum(np.abs(along) - patty.half[0], np.abs(across) - patty.half[1])
    return along, across, np.asarray(far, np.float32)


def _cotton(
    drawn: Sequence[Map], patty: Patty, colour: Map, bumps: Map, x: Map, y: Map, blood: float
) -> tuple[Map, Map]:
    """White felt with a blue thread, a little soaked at its edges."""
    ragged, weave, stains = drawn
    along, across, far = _placed(patty, x, y)
    far = far + 0.12 * ragged
    cover = _step(0.5 - far / 0.25)[..., None]
    felt = np.array([0.86, 0.82, 0.76], np.float32) * (1 + 0.06 * weave)[..., None]
    soaked = blood * np.clip(1.2 + far / 1.2 + 0.5 * stains, 0, 1.5)
    felt = felt * np.exp(-soaked[..., None] * np.array([0.15, 1.3, 1.4], np.float32))
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


def _under(surface: CortexSurface, xy: Floats) -> Floats:
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
