"""Rim of the opening, outwards: the dura's cut edge, folded dura, gutter, wall of bone or muscle, drapes.

Distances are from the opening's edge [mm], albedos linear RGB, absorptions optical depths in each channel.
No number here was measured: all were chosen by eye on an intra-operative photograph.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from scipy.spatial import cKDTree

from synth.arrays import Floats, Map
from synth.geometry.triangles import Shape, grid_faces, joined
from synth.render.anatomy import noise, scenery, tube
from synth.render.anatomy.chart import places
from synth.render.anatomy.layers import Rgb, over, ridge, speckled, step, through
from synth.render.anatomy.surface import CortexSurface
from synth.render.anatomy.texture import normals, thickness
from synth.render.appearance.family import Appearance
from synth.render.materials import Coat

_AROUND, _OUT = 320, 42  # at most: points around the opening, rings outwards
_SEGMENT_PX = 4.0  # least distance of points around in the picture: the mesh is built anew every frame
_WIDTH_MM = 26.0  # of the rim; the picture ends before


class CutEdge:
    """Cross-section of the dura's cut edge [mm]: rings from its underside over its lip to the fold."""

    lip: float = 0.5  # overhang over the brain
    inside: tuple[float, ...] = (1.0, 0.96, 0.72, 0.44, 0.2, 0.04)  # its rings, as shares of the lip
    height: tuple[float, ...] = (-1.8, -0.12, 0.10, 0.26, 0.38, 0.46)  # of its rings over the brain
    painted: tuple[float, ...] = (-3.0, -1.5, -1.2, -0.95, -0.7, -0.3)  # radii of its rings in the texture
    fold: tuple[float, float] = 0.12, 0.5  # start of the folded dura: outwards, over the brain
    shadow: Rgb = (0.35, 0.9, 1.0)  # absorption that darkens its underside


class FoldedDura:
    """The dura folded back over the rim [mm]; `width`: mean and spread around the opening, see `_uneven`."""

    width: tuple[float, float] = 3.1, 0.7
    pleats: tuple[float, float] = 3.0, 1.2  # factor of the fold's height, phase of the pleats; no lengths
    pulled: tuple[float, float] = 1.3, 1.6  # added width at a stitch, and over what distance aside
    vessel: Rgb = (0.35, 1.0, 0.95)  # absorption of its vessels


class Wound:
    """Gutter behind the dura, and the wall beyond that rises in two steps [mm]."""

    gutter: tuple[float, float] = 1.7, 0.6  # width: mean and spread
    floor: float = 1.3  # height over the brain
    rise: tuple[float, float] = 1.5, 0.8  # height of the first and second step
    first: float = 0.4  # from the wall's foot to the first step
    second: tuple[float, float] = 2.4, 0.7  # to the second step: mean and spread
    shadow: Rgb = (0.8, 1.1, 1.1)  # absorption that darkens the gutter
    fat: Rgb = (0.72, 0.46, 0.22)  # albedo
    blood: Rgb = (0.26, 2.4, 2.8)  # absorption


class Bone:
    """Albedos of compact bone and of its spongy section, absorption of blood stains."""

    compact: Rgb = (0.82, 0.71, 0.54)
    spongy: Rgb = (0.62, 0.30, 0.22)
    stain: Rgb = (0.2, 1.2, 1.4)


class Drape:
    """Surgical drapes: distance behind the wall's foot [mm], and albedos."""

    away: tuple[float, float] = 3.0, 0.8  # mean and spread
    blue: Rgb = (0.07, 0.20, 0.42)
    green: Rgb = (0.06, 0.28, 0.26)
    blood: Rgb = (0.22, 0.02, 0.02)


@dataclass(frozen=True)
class Rim:
    """The rim as a mesh, and the outlines that its maps are painted by."""

    shape: Shape
    uv: Map  # (V, 2)
    extent_mm: float  # side of the square that uv spans
    edge: Floats  # (A,) mm: radius of the opening's edge at even angles
    cotton: bool  # whether the texture's unused middle has the felt of patties over the edge
    stitches: Floats  # (n,) rad: angles of threads that hold the dura
    dura: Floats  # (A,) mm beyond the edge: end of the folded dura, start of the gutter
    wall: Floats  # (A,) mm beyond the edge: foot of the wound's wall
    bone: bool  # whether the wall is of bone, else of muscle
    cloth: Floats  # (A,) mm beyond the edge: start of the drapes; empty without drapes


def build(surface: CortexSurface, radius_mm: float, appearance: Appearance, mm_per_px: float) -> Rim:
    """The rim around an opening of `radius_mm` in the surface, as fine as pixels of `mm_per_px` resolve."""
    rng = np.random.default_rng([appearance.rim_seed, 0])
    around = int(np.clip(2 * np.pi * radius_mm / (_SEGMENT_PX * mm_per_px), 96, _AROUND))
    part = np.linspace(0, 1, round(_OUT * around / _AROUND))
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    edge = radius_mm * _outline(rng, angle)
    out = _WIDTH_MM * (0.4 * part + 0.6 * part**3)
    away = np.concatenate([-CutEdge.lip * np.array(CutEdge.inside), out + CutEdge.fold[0]])
    up = np.concatenate([CutEdge.height, CutEdge.fold[1] + 0.05 * out])
    away = np.broadcast_to(away, (around, len(away)))
    xy = _places(angle, edge[:, None] + away)
    flat = xy.reshape(-1, 2)
    extent = 2 * (radius_mm * 1.25 + _WIDTH_MM)

    def sampled(image: Map) -> Map:
        return noise.sample(image, flat, extent).reshape(away.shape)

    folds = 0.2 * noise.band(rng, 256, extent, 6.5, 0.5) + 0.05 * noise.band(rng, 256, extent, 1.8, 0.5)
    z = _under(surface, flat).reshape(away.shape) + up
    z += np.clip(away - 0.1, 0, 3.0) / 3.0 * sampled(folds)
    stitches = scenery.stitches(edge, rng)
    if appearance.family == "calf":  # the dura of a specimen is not sewn back
        stitches = stitches[:0]
    asides = [scenery.aside(angle, stitch)[:, None] * float(edge.mean()) for stitch in stitches]
    wider, within = FoldedDura.pulled
    dura = _uneven(rng, angle, *FoldedDura.width)
    dura = dura + sum(wider * ridge(aside[:, 0], within) for aside in asides)
    wall = dura + _uneven(rng, angle, *Wound.gutter)
    cloth = wall + _uneven(rng, angle, *Drape.away) if "drape" in appearance.scenery else np.zeros(0)
    beyond = step((away - dura[:, None]) / 0.35 - 0.4)
    z += _folded(away, dura[:, None], _uneven(rng, angle, *FoldedDura.pleats)[:, None], asides) * (1 - beyond)
    bone = "bone" in appearance.scenery
    steps = wall + Wound.first, wall + _uneven(rng, angle, *Wound.second)
    risen = sum(high * step((away - at[:, None]) / 0.7) for at, high in zip(steps, Wound.rise, strict=True))
    lumps = sampled(noise.band(rng, 256, extent, 2.6, 0.6))
    lumpy = (0.12 if bone else 0.4) * np.minimum(risen, 1) * lumps
    z += beyond * (Wound.floor - CutEdge.fold[1] + risen + lumpy)
    if len(cloth):
        z += step((away - cloth[:, None]) / 1.2 - 0.5) * (1.0 + 0.7 * lumps)
    vertices = np.concatenate([xy, z[..., None]], axis=-1).reshape(-1, 3)
    painted = edge[:, None] + np.concatenate([CutEdge.painted, away[0, len(CutEdge.painted) :]])[None]
    faces = grid_faces(around, away.shape[1], "rows").reshape(-1, 3)
    parts = [(vertices, faces, _places(angle, painted).reshape(-1, 2))]
    cotton = "cottonoid" in appearance.scenery
    if cotton:
        # Their felt is painted in the middle of the maps, which the opening leaves free.
        parts += scenery.patties(edge, np.concatenate([surface.vertices, vertices]), rng)
    uv = (np.concatenate([place for *_, place in parts]) / extent + 0.5).astype(np.float32)
    mesh = joined(*(Shape(vertices, faces) for vertices, faces, _ in parts))
    return Rim(mesh, uv, extent, edge, cotton, stitches, dura, wall, bone, cloth)


def paint(rim: Rim, appearance: Appearance, pixels: int) -> Coat:
    """Maps of the rim, `pixels` on a side."""
    rng = np.random.default_rng([appearance.rim_seed, 1])
    extent = rim.extent_mm
    wide = noise.fractal(rng, pixels, extent, 8.0, 2.6)
    mottle = noise.fractal(rng, pixels, extent, 2.2, 2.3)
    grain = noise.fractal(rng, pixels, extent, 0.6, 1.6)
    streaks = noise.fractal(rng, 512, 512.0, 24.0, 1.2)
    swell = noise.band(rng, pixels, extent, 1.4, 0.5)
    axis = noise.centres(pixels, extent)
    x, y = np.broadcast_to(axis, (pixels, pixels)), np.broadcast_to(axis[:, None], (pixels, pixels))
    vessels = tube.raster(scenery.dural_vessels(rim.edge, rng), pixels, extent)
    maps = [x, y, wide, mottle, grain, swell, *vessels]
    if rim.cotton:
        ragged = noise.fractal(rng, pixels, 60.0, 1.5, 1.5)
        weave = noise.band(rng, pixels, 60.0, 0.5, 0.5)
        maps += [ragged, weave, noise.fractal(rng, pixels, 60.0, 4.0, 2.0)]
    colour, bumps, thin = noise.in_rows(partial(_paint_rows, rim, appearance, streaks), *maps)
    dry = cv2.resize(thin, (256, 256), interpolation=cv2.INTER_AREA)
    bent = normals(noise.blur(bumps.astype(np.float32), 0.2, extent), extent)
    return Coat(colour, bent, dry.astype(np.float32))


def shade(rim: Rim, surface: CortexSurface) -> Map:
    """Share (512, 512) of light that the dura's lip lets reach the surface, over its chart."""
    x, y = places(surface.chart, 512).T.reshape(2, 512, 512)
    inside = np.maximum(_round(rim.edge, np.arctan2(y, x)) - CutEdge.lip - np.hypot(x, y), 0)
    return np.asarray(1 - 0.35 * np.exp(-inside / 0.6) - 0.14 * np.exp(-inside / 2.0), np.float32)


def inside(rim: Rim, x: Map, y: Map) -> Map:
    """Share of the opening at x, y mm (...): 1 in it, 0 under the rim, soft over a millimetre."""
    return step((_round(rim.edge, np.arctan2(y, x)) - np.hypot(x, y)) / 1.0)


def _round(values: Floats, angle: Map) -> Map:
    """Values (A,) at even angles, interpolated at angles (...) rad."""
    closed = np.append(values, values[0])
    even = np.linspace(0, 2 * np.pi, len(closed))
    return np.asarray(np.interp(angle % (2 * np.pi), even, closed), np.float32)


def _places(angle: Floats, radius: Floats) -> Floats:
    """World x, y (A, R, 2) mm of points at angles (A,) rad and radii (A, R) mm."""
    return np.stack([radius * np.cos(angle)[:, None], radius * np.sin(angle)[:, None]], axis=-1)


def _outline(rng: np.random.Generator, angle: Floats) -> Floats:
    """Relative radius of an opening cut by hand: between a circle and a rounded polygon, ragged."""
    corners = int(rng.integers(5, 8))
    part = 2 * np.pi / corners
    phase = (angle + rng.uniform(0, part)) % part - part / 2
    polygon = np.cos(part / 2) / np.cos(phase)
    shape = 0.65 + 0.35 * polygon / polygon.mean()
    # Spread of each wave's amplitude, as a share of the radius: slow deviations, then a ragged cut.
    for order, spread in [(n, 0.045 / n) for n in range(2, 9)] + [(n, 0.0010) for n in range(12, 40)]:
        shape += rng.normal(0, spread) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
    return np.asarray(shape)


def _uneven(rng: np.random.Generator, angle: Floats, mean: float, spread: float) -> Floats:
    """A distance (A,) mm that varies at random around the opening."""
    wave = np.full_like(angle, mean)
    for order in range(2, 14):
        wave += rng.normal(0, spread / order**0.7) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
    return np.maximum(wave, 0.35 * mean)


def _folded(away: Floats, dura: Floats, pleats: Floats, asides: list[Floats]) -> Floats:
    """Height (A, R) mm of the folded dura: its fold, pleats, free end, and rays and tents at stitches; all in
    mm: `away` from the edge, `dura` its end, `asides` from each stitch."""
    raised = 0.11 * pleats * ridge(away, at=0.8, width=0.5)
    raised += 0.2 * np.sin(3.2 * away + 2 * pleats) * np.clip(away - 0.8, 0, 1)
    # It leans against the wall: its free end is the highest, and curls.
    raised += 0.36 * np.clip(away, 0, None) + 0.35 * ridge(away - dura, at=-0.3, width=0.28)
    for aside in asides:
        raised += 0.2 * np.cos(aside * 3.6) * ridge(aside, width=2.4) * np.clip(away / 1.5, 0, 1)
        raised += 0.55 * np.exp(-((aside / 1.2) ** 2) - ((away - 1.0) / 1.3) ** 2)
    return np.asarray(np.where(away > 0, raised, 0.0))


def _paint_rows(rim: Rim, appearance: Appearance, streaks: Map, *maps: Map) -> tuple[Map, Map, Map]:
    """Albedo (r, n, 3), bumps mm and dry share (r, n) of some rows of the maps; see `paint` for `maps`."""
    x, y, wide, mottle, grain, swell, distance, radius, *cotton = maps
    angle = np.arctan2(y, x)
    away = (np.hypot(x, y) - _round(rim.edge, angle)).astype(np.float32)
    reach, past = _round(rim.dura, angle), away - _round(rim.wall, angle)
    fibres = _fibres(streaks, angle, away, float(rim.edge.mean()))
    outer = step((away - reach) / 0.3 + 0.2 * mottle)
    gutter = outer * (1 - step(past / 0.9 + 0.25 * mottle))
    bumps = 0.035 * mottle + 0.006 * swell
    beyond = _muscle(appearance, past, mottle, grain)
    if rim.bone:
        beyond = _bone(beyond, past, mottle, grain)
        bumps *= np.where(past > 0.6, 0.4, 1.0).astype(np.float32)
    colour = over(_dura(appearance, fibres, mottle, grain, distance, radius), beyond, outer[..., None])
    if not rim.bone:
        fat = 0.7 * step(wide * 1.5 - 1.4 + 0.4 * mottle) * step(past)
        colour = over(colour, speckled(Wound.fat, 0.10 * grain), fat[..., None])
    blood = _blood(appearance.blood, 0.8 * wide + 0.25 * mottle + 0.3 * fibres, gutter)
    colour = _shadowed(through(colour, blood, Wound.blood), away, reach, past, gutter)
    dry = np.clip(0.55 + 0.3 * wide - 0.8 * blood - 0.5 * gutter, 0.02, 1)
    if len(rim.cloth):
        cloth = away - _round(rim.cloth, angle)
        colour, bumps, dry = _draped(appearance, cloth, mottle, grain, colour, bumps, dry)
    colour, bumps = scenery.threaded(rim.stitches, angle, away, float(rim.edge.mean()), colour, bumps)
    if rim.cotton:
        colour, bumps = scenery.with_felt(x, y, cotton, appearance.blood, colour, bumps)
    colour = np.clip(colour, 0.006, 0.92).astype(np.float32)
    return colour, np.asarray(bumps, np.float32), np.asarray(dry, np.float32)


def _fibres(streaks: Map, angle: Map, away: Map, radius: float) -> Map:
    """Fibres of the dura that run outwards: noise (512, 512) stretched in that direction."""
    u = (angle / (2 * np.pi) % 1.0 * 512).astype(np.float32)
    v = (np.clip(away, 0, None) * 2.2 * 512 / (2 * np.pi * radius) % 512).astype(np.float32)
    return np.asarray(cv2.remap(streaks, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32)


def _dura(appearance: Appearance, fibres: Map, mottle: Map, grain: Map, distance: Map, radius: Map) -> Map:
    """Albedo of the folded dura, with its vessels and the redder margin along them."""
    margin = 0.35 * np.exp(-np.maximum(distance - radius, 0) / 0.25) * np.clip(radius / 0.2, 0, 1)
    blood = 4.5 * thickness((distance, radius)) + margin
    pale = speckled(appearance.dura_albedo, 0.05 * fibres, 0.05 * mottle, 0.02 * grain)
    return through(pale, blood, FoldedDura.vessel)


def _muscle(appearance: Appearance, past: Map, mottle: Map, grain: Map) -> Map:
    """Albedo of cut muscle with its strands, and of pale fascia at the wall's edge."""
    strands = speckled(appearance.surroundings_albedo, 0.18 * mottle, 0.04 * grain)
    fascia = 0.45 * ridge(past - 1.0 - 0.3 * mottle, width=0.3)[..., None]
    return np.asarray(over(strands, np.asarray(appearance.dura_albedo), fascia), np.float32)


def _bone(beyond: Map, past: Map, mottle: Map, grain: Map) -> Map:
    """Albedo with bone over the wall's first millimetres: spongy in section, compact on top, stained."""
    compact = speckled(Bone.compact, 0.06 * mottle, 0.03 * grain)
    compact = through(compact, np.clip(0.7 * mottle - 0.5, 0, 2), Bone.stain)
    cut = 0.6 * ridge(past, at=0.35, width=0.25)[..., None]
    bone = over(compact, speckled(Bone.spongy, 0.25 * grain), cut)
    return np.asarray(over(beyond, bone, step((3.9 + 0.5 * mottle - past) / 0.6)[..., None]), np.float32)


def _blood(level: float, uneven: Map, gutter: Map) -> Map:
    """Optical depth (r, n) of blood at a level from 0 (none) to 1 (soaked): uneven, most in the gutter."""
    gathered = 2.4 * level - 1.9 + uneven + (0.3 + 2.6 * level) * gutter
    return np.asarray((0.02 + 0.4 * np.log1p(np.exp(2.0 * gathered))) * min(1.0, 8 * level))


def _shadowed(colour: Map, away: Map, reach: Map, past: Map, gutter: Map) -> Map:
    """Albedo with a pale thin lip, darkened under the lip, in the gutter, and most at its two borders."""
    pale = colour * (1 + 0.12 * ridge(away, at=-0.1, width=0.35)[..., None])
    crevice = np.minimum(np.abs(away - reach - 0.25), np.abs(past) + 0.1)
    lost = 0.7 * gutter + 0.8 * ridge(crevice, width=0.3)
    return through(through(pale, np.clip(-away - 1.5, 0, 1), CutEdge.shadow), lost, Wound.shadow)


def _draped(
    appearance: Appearance, past: Map, mottle: Map, grain: Map, colour: Map, bumps: Map, dry: Map
) -> tuple[Map, Map, Map]:
    """Albedo, bumps and dry share with blue or green drapes from `past` = 0 mm on, bloody at their border."""
    cloth = speckled((Drape.blue, Drape.green)[appearance.rim_seed % 2], 0.10 * grain, 0.05 * mottle)
    blood = np.clip(appearance.blood * (1.1 - past / 2.0) + 0.3 * mottle, 0, 1.2)[..., None]
    cloth = cloth * (1 - 0.6 * np.minimum(blood, 1)) + np.array(Drape.blood, np.float32) * 0.6 * blood
    cover = step(past / 0.3 - 0.5)
    colour = np.asarray(colour + (cloth - colour) * cover[..., None], np.float32)
    return colour, np.asarray(over(bumps, 0.012 * grain, cover), np.float32), np.maximum(dry, cover)


def _under(surface: CortexSurface, xy: Floats) -> Floats:
    """Height of the smoothed surface below points, extrapolated beyond the patch."""
    half = surface.extent_mm / 2
    inner = np.clip(xy, -half, half)
    _, near = cKDTree(surface.vertices[:, :2]).query(inner, k=16)
    height = surface.vertices[:, 2][near].mean(axis=1)
    # The patch's own dome, as the paraboloid through its heights.
    r2 = (surface.vertices[:, :2] ** 2).sum(axis=1)
    (slope, _), *_ = np.linalg.lstsq(np.stack([r2, np.ones_like(r2)], 1), surface.vertices[:, 2], rcond=None)
    return np.asarray(height + slope * ((xy**2).sum(axis=1) - (inner**2).sum(axis=1)))
