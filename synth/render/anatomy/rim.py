"""Rim of the opening, outwards: the dura's cut edge, folded dura, gutter, wall of bone or muscle, drapes.

Distances are from the opening's edge [mm], albedos linear RGB, absorptions optical depths in each channel.
No number here was measured: all were chosen by eye on an intra-operative photograph.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from synth.arrays import Array, Floats, Map, Mask
from synth.geometry.triangles import Shape, grid_faces
from synth.render.anatomy import noise
from synth.render.anatomy.chart import places
from synth.render.anatomy.layers import Rgb, attenuate, over, ridge, speckle, step
from synth.render.anatomy.surface import CortexSurface
from synth.render.anatomy.texture import normals
from synth.render.appearance.family import Appearance
from synth.render.materials import Coat

_AROUND, _OUT = 240, 24  # at most: points around the opening, rings outwards
_SEGMENT_PX = 4.0  # least distance of points around in the picture: the mesh is built anew every frame
_FINE = 8192  # angles at which outlines are read
_TILE = 512  # side of the map of the finest noise
_WIDTH_MM = 26.0  # of the rim; the picture ends before


class Opening:
    """The outline: dura pulled tight between stitches; pairs are ranges."""

    stitches: tuple[int, int] = (6, 10)
    jitter: float = 0.3  # of a stitch along the edge, as a share of the distance to the next
    pull: tuple[float, float] = 0.97, 1.05  # relative radius at a stitch
    sag: tuple[float, float] = 0.0, 0.03  # of the edge between two stitches, into the opening
    corner: float = 0.07  # rad, standard deviation of the corners' rounding


class CutEdge:
    """Cross-section of the dura's thin cut edge [mm]: rings from the fluid below over its lip to its top."""

    lip: float = 0.45  # overhang over the brain
    inside: tuple[float, ...] = (1.5, 1.0, 0.7, 0.35, 0.05)  # its rings, as shares of the lip
    height: tuple[float, ...] = (-1.1, 0.0, 0.09, 0.17, 0.23)  # of its rings over the brain
    painted: tuple[float, ...] = (-2.6, -1.1, -0.8, -0.5, -0.2)  # radii of its rings in the texture
    top: tuple[float, float] = 0.12, 0.26  # start of the dura's outer face: outwards, over the brain
    albedo: Rgb = (0.9, 0.7, 0.58)  # of its section
    width: float = 0.2
    shadow: Rgb = (0.2, 0.5, 0.55)  # absorption that darkens its underside


class Suture:
    """A stitch's black thread."""

    albedo: Rgb = (0.025, 0.025, 0.035)
    half_mm: float = 0.075
    raised_mm: float = 0.08


class Dura:
    """The dura around the opening, pulled up at stitches, folded between them [mm]."""

    width: tuple[float, float] = 1.3, 1.1  # mean and spread around the opening, see `_rough_wave`
    pulled: tuple[float, float] = 2.1, 2.2  # added width at a stitch, and over what distance aside
    slope: float = 0.25  # rise outwards
    tent: tuple[float, float] = 0.5, 1.3  # height at a stitch, and over what distance
    folds: tuple[float, float, float] = 0.11, 2.1, 2.8  # height, waves per mm aside, and reach at a stitch
    soaked: tuple[float, float] = 2.8, 1.4  # its blood by the level, and by chance from place to place,
    stained: tuple[float, float] = 1.3, 0.5  # more towards its end, and the part of it that stays clean
    taut: tuple[float, float] = 0.018, 3.2  # height of the creases that its pull draws along the edge, waves
    # per mm across them, about ten times as many as along
    vessels: tuple[float, float] = 0.055, 0.5  # width of its vessels in the noise, and their optical depth
    thin: Rgb = (0.2, 0.7, 0.6)  # absorption where it is thin, and what is below shines through


class Flap:
    """Flaps of dura that are turned over, unevenly, and show their inner face up to a crease [mm]."""

    count: tuple[int, int] = (2, 5)
    corners: tuple[int, int] = (11, 19)  # between straight cuts of the scissors
    cut: tuple[float, float] = 0.4, 2.6  # what they leave at a corner
    width: tuple[float, float] = 0.8, 4.6  # of the inner face in a flap's middle
    beyond: float = 1.6  # by how much the dura ends beyond the crease, at most
    long: tuple[float, float] = 0.4, 1.1  # rad, half of a flap's length
    ragged: float = 0.12  # spread of the dura's end, as cut by hand
    height: float = 0.16  # of the crease
    albedo: Rgb = (0.87, 0.66, 0.53)  # of the inner face: smooth and pale
    shadow: Rgb = (0.7, 1.0, 1.0)  # absorption beside the crease
    thread_share: float = 0.7  # share of the stitches whose thread is seen


class Blood:
    """Blood on the dura: pools with a level surface, smears wiped along the edge, drops."""

    pool: tuple[float, float] = 4.2, 0.45  # optical depth where deepest, and how much of the noise is one
    runs: tuple[float, float] = 2.4, 2.2  # mm that one runs over the dura's end, thinning; its optical depth
    smear: float = 0.8  # optical depth
    flood: tuple[float, float] = 3.0, 0.15  # optical depth of the film over bone and skin on the wound's
    # lower side, and the level from which on it is
    drops: float = 12.0  # mean number on a soaked rim
    drop_mm: tuple[float, float] = 0.12, 0.55  # radius


class Wound:
    """Gutter behind the dura, and the wall of galea and muscle beyond it [mm]."""

    gutter: tuple[float, float] = 0.6, 0.35  # width: mean and spread
    smooth: float = 0.4  # rad over which it follows the dura's end
    floor: float = 0.9  # height over the brain
    rise: float = 2.0  # of the wall
    steep: tuple[float, float] = 2.5, 0.3  # width over which it rises, and its start as a share of that
    shadow: Rgb = (0.6, 0.9, 0.9)  # absorption that darkens the gutter
    blood: Rgb = (0.3, 1.7, 2.1)  # absorption
    bundles: tuple[float, float] = 17.0, 3.0  # texels of noise per mm across and along muscle's fibres
    fascia: Rgb = (0.66, 0.47, 0.38)  # albedo of the whitish sheet that covers some of them
    fat: Rgb = (0.62, 0.38, 0.16)  # albedo
    fatty: float = 0.55  # share of it where there is some


class Skin:
    """Skin behind the wound's wall: its cut edge, rolled outwards, of fat below the pale dermis [mm]."""

    away: tuple[float, float] = 3.4, 1.4  # behind the wall's foot: mean and spread,
    clipped: tuple[float, float] = 1.6, 0.5  # where clips hold it,
    boned: float = 2.6  # and by how much farther behind bone
    albedo: Rgb = (0.78, 0.57, 0.42)
    fat: Rgb = (0.82, 0.60, 0.36)  # in lobules
    dermis: Rgb = (0.80, 0.56, 0.46)
    width: tuple[float, float] = 0.9, 0.3  # of the fat, and of the dermis over it
    stain: Rgb = (0.3, 1.2, 1.35)  # absorption of blood on the fat
    roll: float = 0.8  # height of the edge


class Bone:
    """The bone's cut edge from its foot up: inner table, diploe, outer table, then its outer surface [mm]."""

    tables: tuple[float, float, float] = 0.4, 1.85, 2.35  # ends of the three
    slant: float = 0.35  # spread of the widths at which they are seen
    rise: float = 2.6
    bare: tuple[float, float] = 5.0, 1.5  # from its foot to where soft tissue covers it: mean and spread
    compact: Rgb = (0.86, 0.76, 0.58)  # albedo
    spongy: Rgb = (0.80, 0.57, 0.42)  # of the diploe's trabeculae
    marrow: Rgb = (0.38, 0.06, 0.045)  # in its pores
    stain: Rgb = (0.2, 1.2, 1.4)  # absorption of blood


class Drape:
    """Surgical drapes: distance behind the wall's foot [mm], and albedos."""

    away: tuple[float, float] = 3.0, 0.8  # mean and spread
    beyond: float = 1.2  # least distance behind the skin's edge
    towels: tuple[float, float] = 0.96, 1.2  # distance of four straight hems from the middle over that of the
    # nearest place which the drapes reach,
    turned: float = 0.16  # rad, standard deviation of their directions,
    over_wall: float = 0.9  # and least distance behind the wall's foot: they lie over bone and skin
    thread: float = 0.34  # from one of its threads to the next
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
    stitches: Floats  # (n,) rad: angles of the outline's corners
    has_thread: Mask  # (n,) whether a thread holds it
    dura: Floats  # (A,) mm beyond the edge: end of the dura, start of the gutter, as painted
    crease: Floats  # (A,) mm beyond the edge: end of the inner face of what is turned over
    wall: Floats  # (A,) mm beyond the edge: foot of the wound's wall
    bone: bool  # whether the wall is of bone, else of muscle
    bare: Floats  # (A,) mm from the wall's foot to the end of bare bone
    skin: Floats  # (A,) mm beyond the edge: start of the skin
    cloth: Floats  # (A,) mm beyond the edge: start of the drapes; empty without drapes


def build(
    surface: CortexSurface,
    radius_mm: float,
    appearance: Appearance,
    mm_per_px: float,
    seen_mm: float = np.inf,
) -> Rim:
    """The rim around an opening of `radius_mm` in the surface, as fine as pixels of `mm_per_px` resolve.

    `seen_mm`: distance from the middle beyond which nothing is seen, so that nothing is painted there.
    """
    rng = np.random.default_rng([appearance.rim_seed, 0])
    count = int(np.clip(2 * np.pi * radius_mm / (_SEGMENT_PX * mm_per_px), 96, _AROUND))
    fractions = np.linspace(0, 1, round(_OUT * (count / _AROUND) ** 0.5))
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    stitches, relative = _outline(rng, angle)
    edge = radius_mm * relative
    outwards = _WIDTH_MM * (0.4 * fractions + 0.6 * fractions**3)
    distance = np.concatenate([-CutEdge.lip * np.array(CutEdge.inside), outwards + CutEdge.top[0]])
    heights = np.concatenate([CutEdge.height, CutEdge.top[1] + 0 * outwards])
    distance = np.broadcast_to(distance, (count, len(distance)))
    xy = _points(angle, edge[:, None] + distance)
    points = xy.reshape(-1, 2)
    extent = 2 * (radius_mm * 1.25 + _WIDTH_MM)
    noise_map = noise.sample(noise.band(rng, 256, extent, 3.5, 0.6), points, extent).reshape(distance.shape)
    stitch_distances = np.stack([_wrap_angle(angle, stitch) for stitch in stitches]) * float(edge.mean())
    outlines = _outlines(rng, appearance, angle, edge, stitch_distances)
    bone = "bone" in appearance.scenery
    z = (
        _extrapolate_height(surface, points).reshape(distance.shape)
        + heights
        + _relief(outlines, bone, distance, stitch_distances, noise_map)
    )
    vertices = np.concatenate([xy, z[..., None]], axis=-1).reshape(-1, 3)
    painted_radii = (
        edge[:, None] + np.concatenate([CutEdge.painted, distance[0, len(CutEdge.painted) :]])[None]
    )
    faces = grid_faces(count, distance.shape[1], "rows").reshape(-1, 3)
    half = min(extent / 2, seen_mm)  # a map continues beyond its border
    uv = (_points(angle, painted_radii).reshape(-1, 2) / (2 * half) + 0.5).astype(np.float32)
    rng = np.random.default_rng([appearance.rim_seed, 7])
    crease, end = _flaps(rng, angle, outlines.dura)
    has_thread = rng.random(len(stitches)) < Flap.thread_share
    bare = np.maximum(_wave(rng, angle, *Bone.bare), Bone.tables[2] + 1)
    has_thread &= appearance.family != "calf"  # the dura of a specimen is not sewn back
    outside = outlines.wall, bone, bare, outlines.skin, outlines.cloth
    return Rim(Shape(vertices, faces), uv, 2 * half, edge, stitches, has_thread, end, crease, *outside)


@dataclass(frozen=True)
class _Outlines:
    """Ends or starts of the layers around an opening, (A,) mm beyond its edge; no `cloth` without drapes."""

    dura: Floats
    wall: Floats
    skin: Floats
    cloth: Floats


def _outlines(
    rng: np.random.Generator, appearance: Appearance, angle: Floats, edge: Floats, stitch_distances: Floats
) -> _Outlines:
    """The outlines at angles (A,); `stitch_distances`: (n, A) mm along the edge from each stitch."""
    dura = _rough_wave(rng, angle, *Dura.width) + Dura.pulled[0] * ridge(
        stitch_distances, Dura.pulled[1]
    ).max(axis=0)
    # Sawn bone and retracted muscle know nothing of the dura's corners, which may lie on them.
    sigma = len(angle) * Wound.smooth / (2 * np.pi)
    wall = gaussian_filter1d(edge + dura, sigma, mode="wrap") - edge + _wave(rng, angle, *Wound.gutter)
    wall = np.maximum(wall, 0.8)
    has_clips = "clips" in appearance.scenery or "hooks" in appearance.scenery
    bone_mm = Skin.boned * ("bone" in appearance.scenery)
    skin = wall + bone_mm + _wave(rng, angle, *(Skin.clipped if has_clips else Skin.away))
    cloth = wall + _wave(rng, angle, *Drape.away)
    if "drape" not in appearance.scenery:
        return _Outlines(dura, wall, skin, np.zeros(0))
    cloth = edge + np.maximum(cloth, skin + Drape.beyond)
    return _Outlines(
        dura, wall, skin, _towels(appearance, angle, cloth, edge + wall + Drape.over_wall) - edge
    )


def _relief(
    outlines: _Outlines, bone: bool, distance: Floats, stitch_distances: Floats, noise_map: Map
) -> Floats:
    """Height (A, R) mm over its cut edge of a rim with such ends, `distance` (A, R) mm from the edge.

    `stitch_distances`: as of `_outlines`; `noise_map`: (A, R) noise.
    """
    height, reach = Dura.tent
    tents = (
        height
        * ridge(stitch_distances[..., None], reach).max(axis=0)
        * ridge(distance, centre=0.8, width=reach)
    )
    outside = np.clip(distance, 0, None)
    dura = np.where(distance > 0, tents + Dura.slope * outside + 0.15 * np.minimum(outside, 1) * noise_map, 0)
    wall_distance = distance - outlines.wall[:, None]
    over_mm, start = (Bone.tables[2], 0.5) if bone else Wound.steep
    wound = (Bone.rise if bone else Wound.rise) * step(wall_distance / over_mm - start)
    wound = wound + Wound.floor - CutEdge.top[1] + (0.08 if bone else 0.25) * noise_map
    wound = wound + Skin.roll * ridge(distance - outlines.skin[:, None], 1.1, centre=0.5)
    if len(outlines.cloth):
        wound = wound + step((distance - outlines.cloth[:, None]) / 1.2 - 0.5) * (1.0 + 0.7 * noise_map)
    return np.asarray(over(dura, wound, step((distance - outlines.dura[:, None]) / 0.5 - 0.4)))


def _towels(appearance: Appearance, angle: Floats, reach: Floats, least: Floats) -> Floats:
    """Radii (A,) mm at which four straight drapes start, about `reach` and nowhere below `least`."""
    rng = np.random.default_rng([appearance.rim_seed, 8])
    sides = rng.uniform(0, 2 * np.pi) + np.arange(4) * np.pi / 2 + rng.normal(0, Drape.turned, 4)
    hem_distances = float(reach.mean()) * rng.uniform(*Drape.towels, 4)
    cosines = np.cos(_wrap_angle(angle, sides[:, None]))
    hems = np.where(cosines > 0.1, hem_distances[:, None] / np.maximum(cosines, 0.1), np.inf).min(axis=0)
    return np.asarray(np.maximum(hems, least))


def _flaps(rng: np.random.Generator, angle: Floats, dura: Floats) -> tuple[Floats, Floats]:
    """Ends (A,), (A,) mm beyond the edge, of the inner face and of the dura, whose cut is uneven."""
    crease = _rough_wave(rng, angle, 0.3, 0.25)
    for middle in rng.uniform(0, 2 * np.pi, rng.integers(*Flap.count)):
        half_length, width = rng.uniform(*Flap.long), rng.uniform(*Flap.width)
        offset = _wrap_angle(angle, middle + rng.uniform(-0.3, 0.3) * np.cos(angle - middle))
        crease = np.maximum(crease, width * np.clip(1.3 * (1 - (offset / half_length) ** 2), 0, 1) ** 0.7)
    corners = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(*Flap.corners)))
    cut = np.interp(angle, corners, rng.uniform(*Flap.cut, len(corners)), period=2 * np.pi)
    cut_end = over(cut, dura, 0.5 * ridge(dura, 1.2, centre=float(dura.max())))
    roughness = sum(
        rng.normal(0, Flap.ragged / (order / 14) ** 0.8) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
        for order in range(9, 60)
    )
    end = np.maximum(
        cut_end, crease + rng.uniform(0.3, 1) * Flap.beyond * np.abs(_rough_wave(rng, angle, 0.4, 0.5))
    )
    return crease, np.maximum(end + 0.5 * roughness, crease + 0.15)


def paint(rim: Rim, appearance: Appearance, pixels: int, seen: Mask | None = None) -> Coat:
    """Maps of the rim, `pixels` on a side; `seen`: (m, m) where it may be seen; else unpainted."""
    rng = np.random.default_rng([appearance.rim_seed, 1])
    extent = rim.extent_mm

    def draw_noise(longest_mm: float, slope: float, extent_mm: float = extent) -> Map:
        texture = noise.fractal(rng, min(512, pixels), extent_mm, longest_mm, slope)
        return np.asarray(cv2.resize(texture, (pixels, pixels)), np.float32)

    axis = noise.centres(pixels, extent)
    x, y = np.broadcast_to(axis, (pixels, pixels)), np.broadcast_to(axis[:, None], (pixels, pixels))
    maps = [x, y, draw_noise(9.0, 2.4), draw_noise(2.5, 2.2), draw_noise(0.6, 1.4)]
    streaks = noise.fractal(rng, 512, 512.0, 24.0, 1.2)
    maps += [draw_noise(6.0, 3.4), _drops(rng, appearance.blood, rim, pixels), _fine(rng, pixels, extent)]
    hidden = np.hypot(x, y) < float(rim.edge.min()) + min(CutEdge.painted) - 1
    if seen is not None:
        hidden |= cv2.resize(seen.astype(np.float32), (pixels, pixels)) < 0.01
    hidden[0, 0] = False  # a texel at least
    indices = np.flatnonzero(~hidden).astype(np.int32)
    colour, bumps, dry_share = noise.map_pixels(
        partial(_paint_rows, rim, appearance, streaks), indices, (0.2, 0.0, 0.5), *maps
    )
    dry = cv2.resize(dry_share, (256, 256), interpolation=cv2.INTER_AREA)
    return Coat(colour, normals(noise.blur(bumps, 0.07, extent), extent), dry)


def _fine(rng: np.random.Generator, pixels: int, extent_mm: float) -> Map:
    """Noise (n, n) of unit variance down to the texels, of a tile that repeats."""
    tile = noise.fractal(rng, _TILE, _TILE * extent_mm / pixels, 0.8, 1.3)
    return np.tile(tile, (pixels // _TILE + 1,) * 2)[:pixels, :pixels]


def _drops(rng: np.random.Generator, blood: float, rim: Rim, pixels: int) -> Map:
    """Share (n, n) of drops of blood around the opening, round or drawn out."""
    drops, scale = np.zeros((pixels, pixels), np.float32), pixels / rim.extent_mm
    for _ in range(int(rng.poisson(Blood.drops * blood))):
        angle, elongation = rng.uniform(0, 2 * np.pi), rng.uniform(1, 2.2)
        radius = Blood.drop_mm[0] * (Blood.drop_mm[1] / Blood.drop_mm[0]) ** rng.random()
        distance = float(_interpolate(rim.edge, np.full(1, angle, np.float32))[0]) + rng.uniform(0.3, 7.0)
        middle = (distance * np.array([np.cos(angle), np.sin(angle)]) / rim.extent_mm + 0.5) * pixels
        turn = float(rng.uniform(0, 360))
        axes = (2 * radius * scale * elongation, 2 * radius * scale / elongation)
        if min(axes) > 1:
            cv2.ellipse(drops, (middle.tolist(), axes, turn), 1.0, -1, cv2.LINE_AA)
    return noise.blur(drops, 0.12, rim.extent_mm)


def shade(rim: Rim, surface: CortexSurface) -> Map:
    """Share (512, 512) of light that the dura's lip lets reach the surface, over its chart."""
    x, y = places(surface.chart, 512).T.reshape(2, 512, 512)
    inside = np.maximum(_interpolate(rim.edge, np.arctan2(y, x)) - CutEdge.lip - np.hypot(x, y), 0)
    return np.asarray(1 - 0.35 * np.exp(-inside / 0.6) - 0.14 * np.exp(-inside / 2.0), np.float32)


def inside(rim: Rim, x: Map, y: Map) -> Map:
    """Share of the opening at x, y mm (...): 1 in it, 0 under the rim, soft over a millimetre."""
    return step((_interpolate(rim.edge, np.arctan2(y, x)) - np.hypot(x, y)) / 1.0)


def _interpolate(values: Floats, angle: Map) -> Map:
    """Values (A,) at even angles, interpolated at angles (...) rad."""
    ring = np.append(values, values[0])
    table = np.interp(np.arange(_FINE) * (len(values) / _FINE), np.arange(len(ring)), ring)
    indices = np.asarray(angle * (_FINE / (2 * np.pi)), np.int32) % _FINE
    return np.asarray(table.astype(np.float32)[indices])


def _points(angle: Floats, radius: Floats) -> Floats:
    """World x, y (A, R, 2) mm of points at angles (A,) rad and radii (A, R) mm."""
    return np.stack([radius * np.cos(angle)[:, None], radius * np.sin(angle)[:, None]], axis=-1)


def _outline(rng: np.random.Generator, angle: Floats) -> tuple[Floats, Floats]:
    """Angles (n,) rad of stitches, and the relative radius (A,) of an opening of mean 1 pulled tight between
    them: a polygon whose sides sag inwards."""
    count = int(rng.integers(*Opening.stitches))
    stitches = np.arange(count) + rng.uniform(-Opening.jitter, Opening.jitter, count)
    stitches = rng.uniform(0, 2 * np.pi) + stitches * 2 * np.pi / count
    pull, sag = rng.uniform(*Opening.pull, count), rng.uniform(*Opening.sag, count)
    relative = (angle - stitches[0]) % (2 * np.pi)
    side = np.searchsorted(stitches - stitches[0], relative, side="right") - 1
    following = (side + 1) % count
    span, progress = (
        (stitches[following] - stitches[side]) % (2 * np.pi),
        relative - (stitches - stitches[0])[side],
    )
    radius = pull[side] * pull[following] * np.sin(span)
    radius /= pull[side] * np.sin(progress) + pull[following] * np.sin(span - progress)
    radius *= 1 - 4 * sag[side] * (progress / span) * (1 - progress / span)
    sigma = Opening.corner * len(angle) / (2 * np.pi)
    radius = gaussian_filter1d(radius, sigma, mode="wrap")
    for order in range(9, 40):  # cut by hand
        radius += rng.normal(0, 0.0012) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
    return np.sort(stitches % (2 * np.pi)), radius / radius.mean()


def _rough_wave(rng: np.random.Generator, angle: Floats, mean: float, spread: float) -> Floats:
    """A distance (A,) mm that varies at random around the opening."""
    wave = np.full_like(angle, mean)
    for order in range(2, 14):
        wave += rng.normal(0, spread / order**0.7) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
    return np.maximum(wave, 0.35 * mean)


def _wave(rng: np.random.Generator, angle: Floats, mean: float, spread: float) -> Floats:
    """A distance (A,) mm that varies smoothly around the opening."""
    wave = np.full_like(angle, mean)
    for order in range(1, 6):
        wave += rng.normal(0, spread / order) * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
    return np.maximum(wave, 0.3 * mean)


class _Maps(NamedTuple):
    """Some rows (r, n) of what the rim is painted from."""

    x: Map  # mm
    y: Map
    clouds: Map  # noise, from coarse to fine
    mottle: Map
    grain: Map
    spill: Map  # where blood has run
    drops: Map
    fine: Map


def _paint_rows(rim: Rim, appearance: Appearance, streaks: Map, *rows: Map) -> tuple[Map, Map, Map]:
    """Albedo (r, n, 3), bumps mm and dry share (r, n) of some rows of the maps; `rows`: as of `_Maps`."""
    maps = _Maps(*rows)
    angle, mean = np.arctan2(maps.y, maps.x), float(rim.edge.mean())
    distance = (np.hypot(maps.x, maps.y) - _interpolate(rim.edge, angle)).astype(np.float32)
    dura_end, wall_distance = _interpolate(rim.dura, angle), distance - _interpolate(rim.wall, angle)
    fibres = _fibres(streaks, angle, distance, mean)
    outside = step((distance - dura_end) / 0.3 + 0.25 * maps.mottle)
    gutter = outside * (1 - step(wall_distance / 1.5 + 0.3 * maps.mottle))
    stitch = np.searchsorted(0.5 * (rim.stitches[1:] + rim.stitches[:-1]), angle % (2 * np.pi))
    stitch_angle = _wrap_angle(angle, rim.stitches.astype(np.float32)[stitch])
    folds = (
        _folds(np.abs(stitch_angle) * (mean + distance), distance, maps.mottle)
        + _creases(streaks, angle, distance, mean)
    ) * (1 - outside)
    crease_start = _interpolate(rim.crease, angle)
    crease = distance - crease_start - 0.12 * maps.mottle
    inner_face = step(-crease / 0.15) * step(distance / 0.3 - 0.2)
    flap_share = np.clip(crease_start - 0.5, 0, 1)
    fraction = np.clip(distance / np.maximum(dura_end, 0.3), 0, 1.4) + 0.12 * maps.mottle
    blood = _spread_blood(appearance.blood, maps, fibres, outside, crease, fraction)
    section = np.clip(0.6 + 0.3 * maps.clouds + 0.2 * maps.mottle, 0, 0.85)
    section = section * ridge(distance, width=CutEdge.width)
    colour = _paint_dura(appearance, maps, fibres, inner_face, section, blood)
    colour = attenuate(colour, flap_share * step(crease / 0.1) * np.exp(-np.abs(crease) / 0.35), Flap.shadow)
    colour = over(colour, np.asarray(CutEdge.albedo, np.float32), section[..., None])
    surroundings, relief, tight_share = _paint_outside(
        rim, appearance, streaks, (angle, distance, wall_distance), blood.soak, maps
    )
    run_mm, run_depth = Blood.runs
    run = np.clip((distance - dura_end) / run_mm + 0.3 * maps.mottle, 0, 3)
    surroundings = attenuate(
        surroundings, run_depth * blood.pool * np.exp(-run) * (1 - tight_share), Wound.blood
    )
    colour = over(colour, surroundings, outside[..., None])
    colour = attenuate(colour, np.clip(-distance - 1.2, 0, 1), CutEdge.shadow)
    colour = attenuate(
        colour,
        gutter + 0.5 * ridge(distance - dura_end, width=0.4) - 1.5 * np.minimum(folds, 0),
        Wound.shadow,
    )
    wetness = np.maximum(blood.pool, blood.drops) * (1 - tight_share)
    bumps = _raise_bumps(maps, fibres, folds, outside, relief, wetness)
    bumps = bumps + Flap.height * flap_share * (
        step(-crease / 0.5) * (1 - outside) + 0.5 * ridge(crease, width=0.4)
    )
    dry = np.clip(
        0.3
        + 0.3 * (maps.clouds + outside)
        - 0.7 * blood.soak
        - 0.5 * gutter
        + 0.45 * tight_share
        - 0.9 * wetness
        - 0.3 * inner_face,
        0.02,
        1,
    )
    if len(rim.cloth):
        cloth = distance - _interpolate(rim.cloth, angle)
        weave = np.cos(2 * np.pi / Drape.thread * maps.x) * np.cos(2 * np.pi / Drape.thread * maps.y)
        weave = weave + 0.5 * maps.fine
        colour, bumps, dry = _add_drapes(appearance, cloth, maps.mottle, weave, colour, bumps, dry)
    if rim.has_thread.any():
        across = np.where(rim.has_thread[stitch], stitch_angle * (mean + distance), 99.0).astype(np.float32)
        colour, bumps = _add_threads(across, distance, colour, bumps)
    colour = np.clip(colour, 0.006, 0.92).astype(np.float32)
    return colour, np.asarray(bumps, np.float32), np.asarray(dry, np.float32)


class _BloodOnDura(NamedTuple):
    """Blood on the dura, (r, n) each."""

    soak: Map  # optical depth of what it has soaked up
    pool: Map  # share of pools
    drops: Map  # share of drops
    depth: Map  # optical depth of all


def _spread_blood(
    level: float, maps: _Maps, fibres: Map, outside: Map, crease: Map, fraction: Map
) -> _BloodOnDura:
    """Blood at a level from 0 (none) to 1 (soaked); `outside`: share beyond the dura, `crease`: mm from its
    crease, `fraction`: of its width."""
    # Blood knows no crease: it thins over a millimetre.
    clean_share = step((0.35 * fibres + 0.25 * maps.mottle - crease) / 1.6)
    stain, clean_part = Dura.stained
    unevenness = 0.8 * maps.clouds + 0.35 * maps.mottle + 0.3 * fibres + 0.1 * outside - 0.7 * clean_share
    soak = _soak(level, unevenness + stain * (fraction - clean_part))
    pool_depth, pool_level = Blood.pool
    border = 0.12 * maps.mottle + 0.1 * fibres + 0.04 * maps.grain
    filling = maps.spill + border + pool_level * (3 * level - 3.1) - 0.8 * clean_share
    pool = step(1.8 * filling - 0.3) * min(1, 6 * level)
    drops = maps.drops * np.clip(0.8 + 0.45 * maps.mottle + 0.25 * maps.grain, 0, 1.4)
    depth = pool_depth * np.clip(0.15 + 0.9 * filling, 0.12, 1)
    smear = np.clip(0.55 * fibres + 0.5 * maps.clouds - 0.6 + 0.8 * (level - 0.5), 0, 1) * Blood.smear
    total = soak * (1 - 0.4 * pool) + depth * np.maximum(pool, drops) + smear * min(1, 4 * level)
    return _BloodOnDura(soak, pool, drops, total)


def _paint_dura(
    appearance: Appearance, maps: _Maps, fibres: Map, inner_face: Map, section: Map, blood: _BloodOnDura
) -> Map:
    """Albedo (r, n, 3) of the dura under its blood; `inner_face` and `section`: shares of its inner face and
    of its cut."""
    mottle, spill = maps.mottle, maps.spill
    dura = speckle(appearance.dura_albedo, 0.08 * fibres, 0.06 * mottle, 0.02 * maps.grain, 0.035 * maps.fine)
    dura = over(dura, speckle(Flap.albedo, 0.03 * mottle, 0.06 * fibres), 0.75 * inner_face[..., None])
    dura = attenuate(dura, np.clip(0.3 + 0.5 * spill - 0.3 * fibres, 0, 0.8), Dura.thin)
    width, depth = Dura.vessels
    dura = attenuate(
        dura, depth * ridge(mottle + 0.4 * maps.clouds, width) * step(0.5 + 0.6 * spill), Wound.blood
    )
    return attenuate(dura, blood.depth * (1 - 0.7 * section), Wound.blood)


def _raise_bumps(maps: _Maps, fibres: Map, folds: Map, outside: Map, relief: Map, wetness: Map) -> Map:
    """Bumps (r, n) mm, less where fluid levels them; `relief`: of what is beyond the dura."""
    roughness = 0.008 * maps.grain + 0.0015 * maps.fine + outside * (0.0015 * maps.fine + relief)
    dura = 0.005 * maps.mottle + 0.008 * fibres
    bumps = (folds + over(dura, 0.025 * maps.mottle, outside) + roughness) * (1 - 0.75 * wetness)
    return np.asarray(bumps + 0.06 * wetness)


def _paint_outside(
    rim: Rim, appearance: Appearance, streaks: Map, place: tuple[Map, Map, Map], soak_depth: Map, maps: _Maps
) -> tuple[Map, Map, Map]:
    """Albedo (r, n, 3), bumps (r, n) mm and the share of bone and skin, which soak up no fluid, beyond the
    dura's end.

    `place`: angle, distance from the opening's edge and from the wall's foot; `soak_depth`: of the dura.
    """
    x, y, clouds, mottle, grain, spill, _, fine = maps
    angle, distance, wall_distance = place
    bundles = _bundles(streaks, float(rim.stitches[0]), x, y, clouds, mottle)
    colour, relief = _muscle(appearance, bundles, clouds, mottle, spill, fine)
    colour = attenuate(colour, 0.25 * soak_depth, Wound.blood)
    smear = np.clip(0.3 * bundles + 0.8 * clouds + 0.15 * mottle + 1.2 * appearance.blood - 1.2, 0, 1.2)
    tight_share = np.zeros_like(distance)
    if rim.bone:
        colour, relief, tight_share = _add_bone(
            (colour, relief),
            wall_distance,
            _interpolate(rim.bare, angle),
            smear,
            appearance.blood,
            clouds,
            mottle,
            grain,
            fine,
        )
    colour, relief, skin = _add_skin(
        (colour, relief),
        distance - _interpolate(rim.skin, angle),
        smear,
        appearance.blood,
        mottle,
        grain,
        fine,
    )
    flood_depth, level = Blood.flood
    lower_side = np.cos(angle - float(rim.stitches[-1])) + 0.45 * clouds + 0.1 * mottle + 2 * appearance.blood
    flood = flood_depth * np.clip(lower_side - 1 - level, 0, 1) * np.clip(1.4 - 0.12 * wall_distance, 0, 1)
    colour = attenuate(colour, np.minimum(flood, 6 * appearance.blood), Wound.blood)
    return colour, relief, np.maximum(tight_share, skin)


def _fibres(streaks: Map, angle: Map, distance: Map, radius: float) -> Map:
    """Fibres of the dura that run outwards: noise (512, 512) stretched in that direction."""
    u = (angle / (2 * np.pi) % 1.0 * 512).astype(np.float32)
    v = (np.clip(distance, 0, None) * 2.2 * 512 / (2 * np.pi * radius) % 512).astype(np.float32)
    return np.asarray(cv2.remap(streaks, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32)


def _folds(stitch_distance: Map, distance: Map, mottle: Map) -> Map:
    """Height (r, n) mm of the dura's folds, which run outwards; `stitch_distance`: mm from a stitch."""
    height, waves, reach = Dura.folds
    wave = np.cos(2 * np.pi / waves * stitch_distance + 0.8 * mottle)
    return np.asarray(
        height * wave * ridge(stitch_distance, reach) * np.clip(distance / 0.8, 0, 1), np.float32
    )


def _creases(streaks: Map, angle: Map, distance: Map, radius: float) -> Map:
    """Height (r, n) mm of creases along the edge, by noise (512, 512) stretched in that direction."""
    height, waves = Dura.taut
    u = (angle * (radius * waves * 2.4) % 512).astype(np.float32)
    v = (np.clip(distance, 0, None) * waves * 24 % 512).astype(np.float32)
    texture = cv2.remap(streaks, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(height * texture * np.clip(distance / 0.3, 0, 1), np.float32)


def _soak(level: float, unevenness: Map) -> Map:
    """Optical depth (r, n) of blood at a level from 0 (none) to 1 (soaked), by `unevenness` noise."""
    level_gain, noise_gain = Dura.soaked
    return np.asarray(
        np.log1p(np.exp(2.5 * (level_gain * level - 1.0 + noise_gain * unevenness))) * min(0.4, 4 * level)
    )


def _bundles(streaks: Map, turn: float, x: Map, y: Map, clouds: Map, mottle: Map) -> Map:
    """Bundles of fibres along one direction, at an angle `turn` rad: noise (512, 512) drawn out."""
    across, along = Wound.bundles
    u = (across * (np.cos(turn) * x + np.sin(turn) * y) + 6 * clouds).astype(np.float32) % 512
    v = (along * (np.cos(turn) * y - np.sin(turn) * x) + mottle).astype(np.float32) % 512
    texture = cv2.remap(streaks, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(np.clip(texture, -1.5, 2.0), np.float32)


def _muscle(
    appearance: Appearance, bundles: Map, clouds: Map, mottle: Map, spill: Map, fine: Map
) -> tuple[Map, Map]:
    """Albedo (r, n, 3) and bumps (r, n) mm of muscle, partly under its fascia, with fat in places."""
    colour = speckle(appearance.surroundings_albedo, 0.2 * clouds, 0.05 * mottle, 0.3 * bundles, 0.08 * fine)
    fascia = speckle(Wound.fascia, 0.14 * bundles, 0.05 * mottle, 0.06 * fine)
    fascia_share = 0.85 * step((0.4 * bundles - 0.9 * spill - 0.5) / 1.1)
    colour = over(colour, fascia, fascia_share[..., None])
    fat_share = Wound.fatty * step(clouds - 0.9 + 0.5 * mottle + 0.2 * bundles)
    colour = over(colour, np.asarray(Wound.fat, np.float32), fat_share[..., None])
    return colour, (0.022 - 0.012 * fascia_share) * bundles


def _add_bone(
    layers: tuple[Map, Map],
    wall_distance: Map,
    bare_mm: Map,
    smear: Map,
    blood: float,
    clouds: Map,
    mottle: Map,
    grain: Map,
    fine: Map,
) -> tuple[Map, Map, Map]:
    """Albedo and bumps with bone over the wall, from its cut edge to where soft tissue covers it, and its
    share; `layers`: albedo and bumps of that, `wall_distance`: mm from the wall's foot."""
    inner, pores, edge = Bone.tables
    # A saw cuts at a slant, so that the skull seems thick here and thin there.
    place = wall_distance / np.clip(1 + Bone.slant * clouds, 0.5, 1.8) + 0.05 * mottle + 0.02 * grain
    spongy_share = step((place - inner) / 0.12) * step((pores - place) / 0.12)
    pore_share = step((grain + 0.3 * mottle + 0.5 * clouds + 0.2 * fine - 1.2) / 0.5) * spongy_share
    surface = step((place - edge) / 0.15)
    compact = speckle(Bone.compact, 0.05 * mottle, 0.025 * grain, 0.03 * fine)
    bone = over(compact, speckle(Bone.spongy, 0.2 * grain, 0.1 * fine), spongy_share[..., None])
    bone = over(bone, np.asarray(Bone.marrow, np.float32), pore_share[..., None])
    ooze = np.clip(0.45 * mottle + 0.15 * grain + 1.2 * blood - 0.5, 0.05, 0.8) * (1 - surface)
    stain = (smear + np.clip(1.2 * blood + 0.3 * mottle - 0.5 * (wall_distance - edge), 0, 0.6)) * surface
    foramen = step((grain - 2.3) / 0.3) * surface
    bone = attenuate(bone, ooze + stain + 1.5 * foramen, Bone.stain)
    bone = attenuate(bone, 0.7 * ridge(place, 0.35), Wound.shadow)
    share = step((wall_distance + 0.1) / 0.12) * step((bare_mm - wall_distance) / 0.3 + 0.4 * mottle)
    bumps = 0.004 * mottle + 0.05 * ridge(place - edge, 0.2) - 0.06 * pore_share - 0.03 * foramen
    colour, relief = layers
    return over(colour, bone, share[..., None]), over(relief, bumps, share), share


def _add_skin(
    layers: tuple[Map, Map], skin_distance: Map, smear: Map, blood: float, mottle: Map, grain: Map, fine: Map
) -> tuple[Map, Map, Map]:
    """Albedo and bumps with skin from `skin_distance` = 0 mm on, fat and dermis in its cut edge, and the
    skin's share; `layers`: albedo and bumps of what it is on."""
    fat_width, dermis_width = Skin.width
    place = skin_distance + 0.12 * mottle
    skin = step(place / 0.2)
    dermis_mm = dermis_width * np.clip(1 + 0.9 * smear - 0.6 * mottle, 0.2, 2)
    lobule_mm = fat_width * np.clip(1 + 0.9 * smear - 0.5 * mottle, 0.1, 2)
    fat = step((place + dermis_mm + lobule_mm) / 0.4) * step(-(place + dermis_mm) / 0.15)
    dermis = step((place + dermis_mm) / 0.15) * (1 - skin)
    colour, relief = layers
    blood_depth = np.clip(0.1 + 0.5 * blood + 0.3 * mottle, 0.05, 0.9)
    fat_colour = attenuate(speckle(Skin.fat, 0.16 * grain, 0.06 * mottle), blood_depth, Skin.stain)
    colour = over(colour, fat_colour, fat[..., None])
    colour = over(colour, speckle(Skin.dermis, 0.06 * mottle, 0.04 * fine), 0.8 * dermis[..., None])
    skin_colour = speckle(Skin.albedo, 0.05 * mottle, 0.02 * grain, 0.015 * fine)
    stain = smear + np.clip(blood * (1.4 - 0.7 * place) + 0.35 * mottle, 0, 1.2)
    pore = step((grain - 1.9) / 0.4)
    skin_colour = attenuate(skin_colour, stain + 0.35 * pore, Wound.blood)
    bumps = 0.012 * grain - 0.015 * pore
    colour = over(colour, skin_colour, skin[..., None])
    return colour, over(relief * (1 - fat) + 0.03 * grain * fat, bumps, np.maximum(skin, dermis)), skin


def _add_drapes(
    appearance: Appearance, distance: Map, mottle: Map, weave: Map, colour: Map, bumps: Map, dry: Map
) -> tuple[Map, Map, Map]:
    """Albedo, bumps and dry share with woven drapes from `distance` = 0 mm on, bloody at their border."""
    cloth = speckle((Drape.blue, Drape.green)[appearance.rim_seed % 2], 0.22 * weave, 0.05 * mottle)
    blood = np.clip(appearance.blood * (1.1 - distance / 2.0) + 0.3 * mottle, 0, 1.2)[..., None]
    cloth = cloth * (1 - 0.6 * np.minimum(blood, 1)) + np.array(Drape.blood, np.float32) * 0.6 * blood
    cover_share = step(distance / 0.3 - 0.5)
    colour = np.asarray(colour + (cloth - colour) * cover_share[..., None], np.float32)
    return (
        colour,
        np.asarray(over(bumps, 0.012 * weave, cover_share), np.float32),
        np.maximum(dry, cover_share),
    )


def _extrapolate_height(surface: CortexSurface, xy: Floats) -> Floats:
    """Height of the smoothed surface below points, extrapolated beyond the patch."""
    half = surface.extent_mm / 2
    patch_xy = np.clip(xy, -half, half)
    _, neighbours = cKDTree(surface.vertices[:, :2]).query(patch_xy, k=16)
    height = surface.vertices[:, 2][neighbours].mean(axis=1)
    # The patch's own dome, as the paraboloid through its heights.
    r2 = (surface.vertices[:, :2] ** 2).sum(axis=1)
    (slope, _), *_ = np.linalg.lstsq(np.stack([r2, np.ones_like(r2)], 1), surface.vertices[:, 2], rcond=None)
    return np.asarray(height + slope * ((xy**2).sum(axis=1) - (patch_xy**2).sum(axis=1)))


def _wrap_angle(angle: Array, stitch: Array | float) -> Array:
    """Signed angle (...) from a stitch, the shorter way [rad]."""
    return np.mod(angle - stitch + np.pi, 2 * np.pi) - np.pi


def _add_threads(across: Map, distance: Map, colour: Map, bumps: Map) -> tuple[Map, Map]:
    """Colour (r, n, 3) and bumps mm with threads: two strands from each stitch, meeting far out.

    `across`, `distance` (r, n) mm: signed distance from the nearest stitch along the edge, and that beyond
    the edge.
    """
    # A loop, round where it pierces the dura, its strands together far out.
    separation = (
        0.42 * np.sqrt(np.clip((distance - 0.9) / 0.7, 0, 1)) * np.clip(1 - (distance - 1.0) / 12.0, 0, 1)
    )
    line = np.where(distance > 0.9, np.abs(np.abs(across) - separation), 9.0)
    threads = step((Suture.half_mm - line) / 0.06 + 0.2)
    colour = colour + threads[..., None] * (np.array(Suture.albedo, np.float32) - colour)
    return colour, bumps + np.float32(Suture.raised_mm) * threads
