"""Texture of one hard part: brushing, wear, coats, serrations, and the blood and water on it.

A closed bar is folded: the half that a microscope above shows, and its mirror image below, have one texture,
so that no seam is in view. Columns run along the part, rows across it. Depths and sizes were chosen by eye.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from synth.arrays import Floats, Indices, Map
from synth.render.anatomy.layers import Rgb, attenuate, over, ridge, step
from synth.render.finish import Finish
from synth.render.idle import CLOTH
from synth.render.materials import FinishMaps

RING = 32  # vertices of each of a closed bar's rings
_ACROSS = 24, 224  # rows of texels, least and most
_COLUMNS, _BLADE_COLUMNS = (
    (4, 640),
    (8, 1600),
)  # of a bar's, by its rows and at most: a wide blade would show few
_WIDE_MM = 5.0  # of a usual part's shown half, by which the texels are as large as the picture's pixels
_PLASTIC = np.full(3, 0.04, np.float32)  # reflectance at right angles, at an index of 1.5
_BLOOD = np.array([0.20, 0.006, 0.005], np.float32)  # albedo of a clot
_THINNED = 0.4  # of blood's depth, on a blade
_FILM = 0.45, 3.2, 3.6  # absorption of a film of blood, passed twice
_LEAST = 0.1  # of the roughness across by that along
_WARP = 0.03  # height of a blade's unevenness
_HOLLOW = 0.2  # depth of a blade's hollow, as a share of half its width
_BLOOD_MM = 0.025  # height of a film of blood
_LINES_PX = 0.8, 1.7  # rows, half the width of lines along a part, and along a blade, where rows run apart
_STEEPEST = 1.0  # slope of bumps
_CHALK, _DULLED = 0.03, 0.8  # light that a handled coat scatters, and rise of its roughness
_ROUNDED = 0.55, 2.6  # light that a coat lacks at a shaft's sides, and the power of the place across
_GLINTS = (0.1, 0.10, 0.42), (-0.62, 0.05, 0.10), (0.9, 0.05, 0.12)  # on a coat: place across, width, light
_BANDS = (0.46, 0.18, 0.45), (-0.4, 0.2, 0.5), (0.98, 0.08, 0.3), (-0.98, 0.08, 0.3)  # dark ones on steel
_BLADE = (0.7, 0.5, 0.55), (-0.8, 0.4, 0.5), (-0.15, 0.1, 0.12)  # dark bands on a flat blade
_REDDENED_MM = 9.0  # reach of the tissue's tint on a blade,
_REDDENED = np.array((0.08, 0.32, 0.38), np.float32)  # and its depth
# The band in which a blade shows the lamps: place across, width, share that scatters.
_FLASH = 0.12, 0.11, 0.6
_BRIM = 0.93, 0.05, 0.35  # its edge: place of the dark line beside it, width, added light
_CREST = 0.05, 0.08, 0.5  # its bright one: place across, width, share of it that scatters
_COLLAR_MM = 0.9, 0.13  # length of the collar in which a coat begins, and width of the grooves beside it
_WEAVE_MM = 0.42  # between the threads of a patty,
_WOVEN = 0.4, 0.04  # light that the gaps between them take, and their depth, mm
_HEM = 0.5, 0.45, 0.12  # width of a patty's rounded border, mm, light that it lacks, and its fall, mm
_DRUNK = 0.45  # depth of blood that cloth takes up
_SOAKED = 0.3, 1.6  # optical depth of thinned blood in a patty, and by how much it falls over its half width
_WINDOW = 0.34, 0.66, 0.5  # of a clip: its start and end along it, and how far across it reaches
_FLESH: tuple[Rgb, ...] = (0.40, 0.07, 0.04), (0.72, 0.50, 0.20), (0.66, 0.44, 0.36)  # muscle, fat, fascia
_FOLDED = "clip", "fold"  # kinds that show the cut edge of skin
_XRAY = np.array((0.03, 0.10, 0.28), np.float32)  # albedo of a patty's thread
_STREAKS = 1.3, 0.16  # of blood along a shaft: wavelength across it, mm, as a share of that along it
_BROAD_MM = 1.2  # half the width of a shaft from which on they are wider
_SMEARED = (
    0.75,
    30.0,
    0.35,
)  # blood wiped along it: level of the noise from which it is, to mm from the tip; its depth
_SERRATION_MM = 0.5, 5.0, 0.45  # of forceps' inner faces: start, end, and period along the tip;
_NOTCHED = 0.3, 0.025  # light that a notch takes, and its depth, mm
_BORE_RINGS = 5.2  # rings of a tube that are inside
_DROPS = 1.2  # mean number of drops of water, per mm under water
_DROPS_MM = 8.0  # from the tip to where they end
_DROP_MM = 0.12, 0.6  # their radii,
_FLAT = 0.2  # and height as a share of it: water spreads on steel
_MARKS_MM = 6.0, 1.1, 0.14  # etched rings: their distance from each other, that of a pair, width


def unfold(profile: Floats, turn: int) -> Map:
    """Place (V, 2) in the texture of a closed bar's vertices (V, 3), from 0 to 1.

    `turn`: column of the texture's middle row.
    """
    rings = profile.reshape(-1, RING, 3)
    offsets = (np.arange(RING) - turn + RING // 2) % RING - RING // 2  # columns from the middle one
    mirrored = np.where(np.abs(offsets) > RING // 4, np.sign(offsets) * RING // 2 - offsets, offsets)
    across = np.tile(_share_of_outline(rings[:, _visible_columns(turn)])[RING // 4 - mirrored], len(rings))
    return np.column_stack([np.repeat(np.linspace(0, 1, len(rings)), RING), across]).astype(np.float32)


def wrap(points: Floats, outline: Floats) -> Map:
    """Place (V, 2), from 0 to 1, in the texture of round rings (R * RING, 3) mm of points (V, 3) mm in them.

    It is linear in z, as is the texture of rings at even distances, so that large faces fit too.
    """
    middles = outline.reshape(-1, RING, 3).mean(axis=1)
    x, y = (points[:, k] - np.interp(points[:, 2], middles[:, 2], middles[:, k]) for k in (0, 1))
    along = np.interp(points[:, 2], middles[:, 2], np.linspace(0, 1, len(middles)))
    return np.column_stack([along, 0.5 - np.arctan2(y, np.abs(x)) / np.pi]).astype(np.float32)


@dataclass(frozen=True)
class _Texels:
    """Where the texels (h, w) of a part are, and the noise on them, of unit variance."""

    kind: str
    sheet: bool
    place: Map  # (h, w, 3) mm
    along: Map  # mm from its tip, or from a sheet's border
    turned: Map  # by how much its outline turns more than a circle's, see `_edges`
    flat: Map  # (w,) share of bumps and brushing that show: little where it narrows to its tip
    half_mm: float  # half its width
    blotch: Map
    mottle: Map
    grain: Map
    lines: Map  # along it

    @property
    def across(self) -> Map:
        """Place (h, 1) across the part, from -1 to 1."""
        return np.linspace(-1, 1, len(self.along), dtype=np.float32)[:, None]


@dataclass(frozen=True)
class _Layers:
    """Maps while they are painted: those of `FinishMaps`, and heights instead of normals."""

    base: Map
    bare: Map
    rough: Map
    mirror: Map
    wet: Map
    bumps: Map  # (h, w) mm


def paint(
    finish: Finish,
    profile: Floats,
    sheet_rows: int,
    turn: int,
    kind: str,
    rng: np.random.Generator,
    mm_per_px: float,
) -> FinishMaps:
    """Maps of a part of vertices (V, 3) mm with its tip at z = 0: rings, or `sheet_rows` rows of a sheet.

    `turn`: as of `unfold`; `mm_per_px`: of the picture, as fine as which they are.
    """
    texels = _lay_out(profile, sheet_rows, turn, kind, rng, mm_per_px)
    layers = _add_water(finish, texels, _add_blood(finish, texels, _body(finish, texels), rng), rng)
    base, mirror, bumps, rough = layers.base, layers.mirror, layers.bumps, np.clip(layers.rough, 0.05, 1)
    if kind in ("suction", "tube"):
        width = texels.along.shape[1]
        bore = (np.linspace(0, 1, width) * (len(profile) // RING - 1) < _BORE_RINGS)[None, :, None]
        base, mirror = base * np.where(bore, 0.06, 1), mirror * np.where(bore, 0.02, 1)
        bumps = np.where(bore[..., 0], 0, bumps)
    rough[..., 0] = np.clip(rough[..., 0], rough[..., 1], rough[..., 1] / _LEAST)
    return FinishMaps(
        base=np.clip(base, 0.003, 0.98).astype(np.float32),
        bare=np.clip(layers.bare, 0, 1).astype(np.float32),
        rough=rough.astype(np.float32),
        wet=np.clip(layers.wet, 0, 1).astype(np.float32),
        mirror=np.clip(mirror, 0, 0.98).astype(np.float32),
        normal=_normals(bumps, texels.place),
    )


def _lay_out(
    profile: Floats, sheet_rows: int, turn: int, kind: str, rng: np.random.Generator, mm_per_px: float
) -> _Texels:
    """The texels of a part; see `paint`."""
    rings = profile.reshape(sheet_rows or -1, RING if not sheet_rows else len(profile) // sheet_rows, 3)
    if sheet_rows:
        height = int(np.clip(_WIDE_MM / mm_per_px, *_ACROSS))
        size = height, 4 * height
        place, turned = _texels(rings, size), np.zeros(size, np.float32)
        sides = np.abs(rings[..., :2])
        along = _texels((sides.max(axis=(0, 1)) - sides).min(axis=-1)[..., None], size)
    else:
        columns = _visible_columns(turn)
        body = rings[len(rings) // 3, columns]
        outline = float(np.linalg.norm(np.diff(body, axis=0), axis=1).sum())
        height = int(np.clip(max(_WIDE_MM, 0.9 * outline) / mm_per_px, *_ACROSS))
        share, most = _BLADE_COLUMNS if kind == "spatula" else _COLUMNS
        size = height, min(share * height, most)
        rows = np.interp(
            np.linspace(0, 1, height), _share_of_outline(rings[:, columns]), np.arange(len(columns))
        )
        place = _texels(rings[:, columns].swapaxes(0, 1), size, rows)
        turned = _texels(_edges(rings)[:, columns].T[..., None], size, rows)
        along = place[..., 2]
    width = float(np.linalg.norm(place[-1] - place[0], axis=-1)[: size[1] // 3].max())
    blotch = noise(place, 8.0 if sheet_rows else max(2.5, 0.8 * width), rng)
    mottle, grain = noise(place, 1.1, rng), noise(place, 0.35, rng)
    across = np.linalg.norm(np.diff(place, axis=0, prepend=place[:1]), axis=-1).cumsum(axis=0)
    relative_width = across[-1] / across[-1, : size[1] // 2].max()
    lines = grain if sheet_rows else _lines(across, _LINES_PX[kind == "spatula"], rng)
    # Where a bar narrows to its tip, the texture's rows run apart, and bumps along them would show its faces.
    flat = np.ones_like(relative_width) if sheet_rows else step(1.6 * relative_width - 0.9)
    return _Texels(
        kind, bool(sheet_rows), place, along, turned, flat, 0.5 * width, blotch, mottle, grain, lines
    )


def _body(finish: Finish, texels: _Texels) -> _Layers:
    """Bare metal with its lines, wear and shapes, under the coat."""
    kind, along, lines, mottle = texels.kind, texels.along, texels.lines, texels.mottle
    wear_level = texels.turned + 0.3 * texels.blotch + 0.15 * texels.grain - 1.6 + 1.5 * finish.wear
    worn_share = step(wear_level / 0.4) * (finish.wear > 0)
    edge = step(texels.turned - 0.8) * (not kind.startswith(("finger", *CLOTH)))
    coat = step((along - finish.bare_mm) / 0.06) * (1 - worn_share)
    bumps = 0.07 * step((along - finish.bare_mm) / 0.25) * (1 - worn_share) + 0.004 * coat * mottle
    bumps = bumps + 0.0012 * (1 - coat) * texels.flat * lines * (1 + 8 * finish.brushed)
    if kind == "spatula":  # no blade is flat: it is hollowed by rolling, and bent in use
        hollow = _HOLLOW * texels.half_mm * texels.across**2 * texels.flat
        bumps = bumps + (_WARP * texels.blotch + hollow) * (1 - coat)
    rubbing = np.exp((0.1 + 0.8 * finish.brushed) * lines)
    streak = 1 + (max(finish.streak, 1.0) - 1) * texels.flat
    rough = np.stack([finish.alpha * streak * (1 - 0.2 * worn_share), finish.alpha * rubbing], axis=-1)
    rough[..., 1] *= 1 - 0.5 * np.maximum(edge, worn_share)
    brightness = 1 + 0.08 * np.maximum(worn_share, edge) + 0.03 * mottle
    base = np.asarray(finish.mirror, np.float32) * brightness[..., None]
    polish = np.zeros_like(along)
    if not (texels.sheet or kind == "spatula"):
        # The dark room beside the lamps and the light between them, as on any round shaft under a microscope.
        darkness = sum(depth * ridge(texels.across - place, width) for place, width, depth in _BANDS)
        base = np.asarray(base * (1 - darkness * texels.flat)[..., None], np.float32)
        polish = _polish(texels, texels.across, _CREST, 0.8 + 0.2 * lines + 0.2 * mottle)
    if kind == "spatula":
        across = _shift_across(texels)
        base = np.asarray(base * _sheen(texels, across), np.float32)
        polish = _polish(texels, across, _FLASH, 0.85 + 0.1 * lines + 0.15 * mottle)
    base, bumps = _engrave(texels, coat, base, bumps)
    # A coat that has been handled: it is dull in places, scratched, and grey where it is chalked.
    handling = step(0.8 * texels.blotch + 0.35 * mottle - 0.3) * coat
    scratch = step(lines - 1.6) * step(1.2 * mottle + 0.3)
    coat_brightness = np.clip(1 + 0.06 * mottle + 0.08 * lines + 0.25 * scratch, 0, 2)[..., None]
    coat_colour = (
        np.asarray(finish.coat, np.float32) * coat_brightness + _CHALK * (handling + scratch)[..., None]
    )
    if not kind.startswith(("finger", "string", "fold", *CLOTH)):
        coat_colour, bumps = _mould(finish, texels, handling, coat_colour, bumps)
    if kind == "patty":
        coat_colour, bumps = _weave(texels, coat_colour, bumps)
    if kind in _FOLDED:
        coat_colour, bumps = _paint_flesh(texels, coat_colour, bumps)
    base = over(base, coat_colour, coat[..., None])
    gloss = finish.coat_alpha * np.array((finish.coat_streak, 1), np.float32)
    rough = over(rough, gloss * (1 + _DULLED * handling[..., None]), coat[..., None])
    bare = (1 - coat) * (1 - finish.scattered) * (1 - polish)
    return _Layers(base, bare, rough, over(base, _PLASTIC, coat[..., None]), np.zeros_like(along), bumps)


def _polish(texels: _Texels, across: Map, band: tuple[float, float, float], coverage: Map) -> Map:
    """Share (h, w) of light that a bright `band` scatters: its place `across`, width and most."""
    place, width, most = band
    share = np.clip(coverage, 0, 1) * texels.flat
    return np.asarray(most * share * ridge(across - place, width), np.float32)


def _sheen(texels: _Texels, across: Map) -> Map:
    """Light (h, w, 3) that a flat blade mirrors, as a share of a lamp's: bent by hand, it shows the dark
    room and the bright field in soft bands along it, red near its tip, darkest beside its bright edges.

    `across`: as of `_shift_across`.
    """
    bent_across = across + 0.015 * texels.lines
    darkness = sum(depth * ridge(bent_across - place, width) for place, width, depth in _BLADE)
    place, width, brightness = _BRIM
    distance = np.abs(texels.across)
    brim = brightness * ridge(distance - 1, 0.5 * width) - 0.3 * ridge(distance - place, width)
    light = np.clip(1 - darkness, 0.2, 1) + brim * texels.flat
    reddening = np.exp(-texels.along / _REDDENED_MM)
    return np.asarray(light[..., None] * (1 - reddening[..., None] * _REDDENED), np.float32)


def _shift_across(texels: _Texels) -> Map:
    """Place (h, w) across a blade from about -1 to 1, shifted as it is bent along it."""
    shift = gaussian_filter1d(texels.blotch.mean(axis=0), 0.1 * texels.blotch.shape[1], mode="nearest")
    return np.asarray(texels.across + 0.35 * shift / max(float(shift.std()), 0.1), np.float32)


def _mould(finish: Finish, texels: _Texels, handling: Map, coat_colour: Map, bumps: Map) -> tuple[Map, Map]:
    """Albedo and bumps of a coat on a round shaft, with the collar in which it begins.

    The microscope's lamps are next to its lens, so that a shaft is darker towards its sides and glints along
    its crest, wherever it points: a coat's own lobe is too wide along it to show a line.
    """
    loss, power = _ROUNDED
    across, along = texels.across, texels.along
    dullness = np.clip(1 - 0.6 * handling + 0.15 * texels.lines + 0.2 * texels.mottle, 0, 1.3)
    glint = sum(light * ridge(across - place, width) for place, width, light in _GLINTS) * dullness
    length, groove = _COLLAR_MM
    collar = step((along - finish.bare_mm) / 0.1) * step((finish.bare_mm + length - along) / 0.1)
    joint = ridge(along - finish.bare_mm, groove) + 0.8 * ridge(along - finish.bare_mm - length, groove)
    joint = joint * (finish.bare_mm > 0)
    if texels.kind == "spatula":  # a flat blade
        loss, glint = 0.0, 0 * glint
    shade = (1 - loss * np.abs(across) ** power) * (1 - 0.35 * collar) * (1 - 0.75 * np.minimum(joint, 1))
    tint = 0.6 + 0.4 * np.asarray(finish.coat, np.float32) / max(*finish.coat, 0.05)
    coat_colour = coat_colour * shade[..., None] + (glint * (1 - np.minimum(joint, 1)))[..., None] * tint
    bumps = np.asarray(bumps + 0.04 * collar - 0.05 * joint, np.float32)
    return np.asarray(coat_colour, np.float32), bumps


def _weave(texels: _Texels, cotton: Map, bumps: Map) -> tuple[Map, Map]:
    """Albedo and bumps of a pad of cotton that soaks up fluid from its border: its threads, over and under
    each other, its rounded border, and the thread that shows in X-rays."""
    along, aside, _ = np.moveaxis(texels.place, -1, 0)
    u, v = (
        (position + 0.04 * texels.mottle + 0.012 * texels.grain) / _WEAVE_MM for position in (along, aside)
    )
    warp_above = np.mod(np.floor(u) + np.floor(v), 2) == 0
    thread = np.where(warp_above, np.sin(np.pi * u) ** 2, np.sin(np.pi * v) ** 2) * (0.8 + 0.2 * texels.grain)
    gap_loss, gap_depth = _WOVEN
    hem_width, hem_loss, hem_fall = _HEM
    hem = np.clip(1 - (texels.along + 0.08 * texels.mottle) / hem_width, 0, 1) ** 2
    cloth = cotton * ((1 - gap_loss * (1 - thread) + 0.05 * texels.blotch) * (1 - hem_loss * hem))[..., None]
    inward_share = np.clip(texels.along / max(texels.half_mm, 0.1), 0, 1)
    soak, decay = _SOAKED
    soak_depth = (
        soak * np.exp(-decay * inward_share) * np.clip(1 + 0.5 * texels.blotch + 0.25 * texels.mottle, 0, 2)
    )
    cloth = attenuate(cloth, soak_depth, _FILM)
    xray = step((0.11 - np.abs(aside + 0.03 * texels.mottle)) / 0.08) * (0.55 + 0.4 * thread)
    return over(cloth, _XRAY, xray[..., None]), bumps + gap_depth * thread - hem_fall * hem


def _paint_flesh(texels: _Texels, coat_colour: Map, bumps: Map) -> tuple[Map, Map]:
    """Albedo and bumps of a fold of cut skin: all of it, or what a clip's window shows of it."""
    share = np.ones_like(texels.along)
    if texels.kind == "clip":
        start, end, reach = _WINDOW
        fraction = texels.along / texels.along.max()
        share = (
            step((fraction - start) / 0.03)
            * step((end - fraction) / 0.03)
            * step((reach - texels.across) / 0.06)
        )
    muscle, fat, fascia = (np.array(colour, np.float32) for colour in _FLESH)
    flesh = muscle * (1 + 0.15 * texels.mottle + 0.06 * texels.grain)[..., None]
    flesh = over(flesh, fat, (0.8 * step((0.6 * texels.blotch + 0.4 * texels.mottle - 0.5) / 0.6))[..., None])
    flesh = over(flesh, fascia, (0.6 * step((texels.mottle - 0.7 * texels.blotch - 0.8) / 0.5))[..., None])
    edge = share * (1 - share) * 4
    relief = (0.012 * texels.mottle + 0.004 * texels.grain) * share - 0.25 * (texels.kind == "clip") * share
    return over(coat_colour, flesh, share[..., None]) * (1 - 0.6 * edge)[..., None], bumps + relief


def _engrave(texels: _Texels, coat: Map, base: Map, bumps: Map) -> tuple[Map, Map]:
    """Base and bumps with forceps' serrations, or the rings that are etched into shafts."""
    along = texels.along
    if texels.kind in ("forceps", "bayonet"):
        start, end, period = _SERRATION_MM
        teeth = step((along - start) / 0.3) * step((end - along) / 0.6) * (1 - coat)
        outward_sign = np.sign(texels.place[:, -1, 0].mean())  # a tine is bowed away from the other one
        inner_side = step((-outward_sign * texels.across - 0.62) / 0.3)
        notch = (0.5 + 0.5 * np.cos(2 * np.pi * along / period)) ** 2 * teeth * inner_side
        loss, depth = _NOTCHED
        return base * (1 - loss * notch[..., None]), bumps - depth * notch
    if texels.kind in ("dissector", "suction"):
        spacing, separation, width = _MARKS_MM
        ring = np.mod(along - 0.5 * spacing, spacing)
        mark = (
            (ridge(ring, width, 0.5) + ridge(ring, width, 0.5 + separation)) * (along > spacing) * (1 - coat)
        )
        return base * (1 - 0.6 * mark[..., None]), bumps - 0.02 * mark
    return base, bumps


def _add_blood(finish: Finish, texels: _Texels, layers: _Layers, rng: np.random.Generator) -> _Layers:
    """With blood: a film that is brightest red where it is thin, a clot where it is thick, and its border.

    It has run and been wiped along a shaft.
    """
    if not finish.blood:
        return layers
    streak = texels.blotch if texels.sheet else _streaks(texels, rng)
    unevenness = 0.5 * streak + 0.25 * min(1.0, texels.half_mm / 3) * texels.blotch
    unevenness = unevenness + 0.1 * (texels.mottle if texels.sheet else texels.lines)
    tip = 0.5 * np.exp(-texels.along / 1.5) * (not texels.sheet)
    share = 2 * finish.blood - 0.4 - texels.along / max(finish.blood_mm, 0.1) + unevenness + tip
    border = texels.along + 0.25 * finish.blood_mm * np.clip(1 - streak, 0, 2)
    reach_share = step((1.3 * finish.blood_mm - border) / 2)
    depth = np.clip(share / 0.9 + 0.2, 0, 1.4) * reach_share
    level, reach, smear_depth = _SMEARED
    smear = 0.75 * streak + 0.2 * texels.mottle + 0.25 * texels.lines - level - texels.along / reach
    depth = np.maximum(
        depth, np.clip(0.7 * smear, 0, smear_depth) * min(1, 3 * finish.blood) * (not texels.sheet)
    )
    if texels.kind == "spatula":  # on a smooth blade it is wiped to a thin film, thicker along its border
        depth = _THINNED * depth * np.clip(0.9 + 0.1 * texels.lines + 0.35 * texels.mottle, 0.2, 1.6)
    # In cloth blood is soaked up, and its threads show.
    film, clot = step(depth / 0.15 - 0.5), 0.92 * step((depth - 0.75) / 0.5) * (not texels.sheet)
    if texels.sheet:
        depth = np.clip(depth * (0.6 + 0.3 * texels.mottle), 0, _DRUNK)
    edge_depth = depth + 0.25 * ridge(depth, 0.12, 0.12) * film
    smoothing = (0.6 * np.maximum(film, clot) * (texels.kind not in CLOTH))[..., None]
    return _Layers(
        base=over(attenuate(layers.base, edge_depth, _FILM), _BLOOD, clot[..., None]),
        bare=layers.bare * (1 - clot),
        rough=over(layers.rough, np.full(1, 0.1, np.float32), smoothing),
        mirror=over(attenuate(layers.mirror, depth, _FILM), _PLASTIC, clot[..., None]),
        wet=film,
        bumps=layers.bumps + _BLOOD_MM * (step(depth / 0.7 - 0.5) + 0.15 * texels.mottle * clot),
    )


def _add_water(finish: Finish, texels: _Texels, layers: _Layers, rng: np.random.Generator) -> _Layers:
    """With water: a wavy film on the tip, drops further up."""
    margin = finish.wet_mm * (1 + 0.5 * texels.blotch) - texels.along
    wetness = step(margin / 1.2 + 0.3 * texels.mottle) * (finish.wet_mm > 0)
    drops = _drops(texels.place, texels.along, finish, rng)
    bumps = layers.bumps + drops + 0.003 * wetness * texels.mottle
    wetness = np.maximum.reduce([0.8 * wetness, layers.wet, step(drops / 0.02 - 0.5)])
    return replace(layers, bumps=bumps, wet=0.3 * wetness if texels.kind in CLOTH else wetness)


def noise(points: Floats | Map, wave_mm: float, rng: np.random.Generator) -> Map:
    """Smooth noise (...) of unit variance at places (..., n) mm."""
    waves = rng.normal(size=(points.shape[-1], 16)) * 2 * np.pi / wave_mm
    phase = rng.uniform(0, 2 * np.pi, 16)
    angle = np.asarray(points, np.float32) @ waves.astype(np.float32) + phase.astype(np.float32)
    return np.asarray(np.cos(angle).sum(axis=-1) / np.float32(np.sqrt(8)), np.float32)


def _visible_columns(turn: int) -> Indices:
    """Columns of a bar's rings in the half that its texture shows, in the order of the texture's rows."""
    return ((turn + np.arange(RING // 4, -RING // 4 - 1, -1)) % RING).astype(np.int32)


def _share_of_outline(half: Floats) -> Floats:
    """Place, from 0 to 1, of columns (R, n, 3) along the outline of a bar's body: its corners have many."""
    sides = np.linalg.norm(np.diff(half[len(half) // 3], axis=0), axis=1)
    return np.asarray(np.append(0, np.cumsum(sides)) / sides.sum())


def _texels(grid: Floats, size: tuple[int, int], rows: Floats | None = None) -> Map:
    """Values of a grid (r, c, n) at texels (h, w): (h, w, n), or (h, w) for n = 1.

    `rows`: (h,) places in the grid of the texels' rows, even if not given.
    """
    across = np.linspace(0, len(grid) - 1, size[0]) if rows is None else rows
    along = np.linspace(0, grid.shape[1] - 1, size[1])
    x, y = np.meshgrid(along.astype(np.float32), across.astype(np.float32))
    return np.asarray(cv2.remap(np.ascontiguousarray(grid, np.float32), x, y, cv2.INTER_LINEAR), np.float32)


def _lines(across: Map, width_px: float, rng: np.random.Generator) -> Map:
    """Lines (h, w) along a part, each of some length, unit variance.

    `across`: (h, w) mm from its one side; `width_px`: half their width, rows.
    """
    height, width = across.shape
    coarse = rng.normal(size=(height, 12)).astype(np.float32)
    lines = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    lines = cv2.GaussianBlur(lines, (1, 0), sigmaX=1e-3, sigmaY=width_px)  # as wide as the picture resolves
    # They are parallel in space: where a bar narrows to its tip, the outer ones end.
    row = (across - across[height // 2]) / np.maximum(across[-1], across[-1, : width // 2].max())
    row = ((height - 1) * row + height // 2).astype(np.float32)
    column = np.broadcast_to(np.arange(width, dtype=np.float32), row.shape)
    lines = cv2.remap(lines, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(lines / lines.std(), np.float32)


def _streaks(texels: _Texels, rng: np.random.Generator) -> Map:
    """Noise (h, w) of unit variance, long along a part, and wide on wide ones."""
    (wave, shortening), place = _STREAKS, texels.place
    widening = max(1.0, texels.half_mm / _BROAD_MM)
    coarse = noise(
        place[::2, ::4] * np.array((1, 1, shortening * widening), np.float32), wave * widening, rng
    )
    return np.asarray(cv2.resize(coarse, place.shape[1::-1], interpolation=cv2.INTER_CUBIC), np.float32)


def _drops(place: Map, along: Map, finish: Finish, rng: np.random.Generator) -> Map:
    """Height (h, w) mm of drops of water on the first part of a bar."""
    heights = np.zeros(along.shape, np.float32)
    if not finish.wet_mm:
        return heights
    reach = np.flatnonzero(
        (along[len(along) // 2] > 0.3) & (along[len(along) // 2] < min(3 * finish.wet_mm, _DROPS_MM))
    )
    for _ in range(rng.poisson(_DROPS * finish.wet_mm) if len(reach) else 0):
        row, column = rng.integers(len(along)), rng.choice(reach)
        radius = float(np.exp(rng.uniform(np.log(_DROP_MM[0]), np.log(_DROP_MM[1]))))
        columns = np.flatnonzero(np.abs(along[row] - along[row, column]) < 2 * radius)
        offsets = place[:, columns] - place[row, column]
        turn = np.arctan2(offsets[..., 1], offsets[..., 2]) + rng.uniform(0, 2 * np.pi)
        radii = radius * (1 + 0.25 * np.cos(2 * turn) + 0.12 * np.cos(3 * turn + 1))
        distances2 = (offsets**2).sum(axis=-1) / radii**2
        heights[:, columns] = np.maximum(heights[:, columns], _FLAT * radius * np.clip(1 - distances2, 0, 1))
    return heights


def _normals(bumps: Map, place: Map) -> Map:
    """Unit normals (h, w, 3) in the tangent frame of heights (h, w) mm on texels at places (h, w, 3) mm."""
    normal = np.ones((*bumps.shape, 3), np.float32)
    for axis in (1, 0):
        step_mm = np.linalg.norm(np.gradient(place, axis=axis), axis=-1)
        slope = np.gradient(np.asarray(bumps, np.float32), axis=axis) / np.maximum(step_mm, 5e-3)
        normal[..., 1 - axis] = -np.clip(slope, -_STEEPEST, _STEEPEST)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True), np.float32)


def _edges(rings: Floats) -> Floats:
    """By how much (R, columns) the outline of rings (R, columns, 3) turns more at vertices than a circle."""
    outline = rings[..., 0] + 1j * rings[..., 1]
    side = np.roll(outline, -1, axis=1) - outline
    turn = np.abs(np.angle(side * np.conj(np.roll(side, 1, axis=1)))) * RING / (2 * np.pi)
    return np.asarray(np.clip(turn - 1, 0, 2))
