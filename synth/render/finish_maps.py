"""Texture of one hard part: brushing, wear, coats, serrations, and the blood and water on it.

A closed bar is folded: the half that a microscope above shows, and its mirror image below, have one texture,
so that no seam is in view. Columns run along the part, rows across it. Depths and sizes were chosen by eye.
"""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Floats, Indices, Map
from synth.render.anatomy.layers import over, ridge, step, through
from synth.render.finish import Finish
from synth.render.idle import CLOTH
from synth.render.materials import FinishMaps

RING = 32  # vertices of each of a closed bar's rings
_ACROSS = 24, 112  # rows of texels, least and most
_WIDE_MM = 5.0  # of a usual part's shown half, by which the texels are as large as the picture's pixels
_PLASTIC = np.full(3, 0.04, np.float32)  # reflectance at right angles, at an index of 1.5
_BLOOD = np.array([0.20, 0.006, 0.005], np.float32)  # albedo of a clot
_FILM = 0.45, 3.2, 3.6  # absorption of a film of blood, passed twice
_LEAST = 0.1  # of the roughness across by that along
_WARP = 0.02  # height of a blade's unevenness
_STEEPEST = 1.0  # slope of bumps
_SERRATION_MM = 0.5, 5.5, 0.38  # of forceps' inner faces: start, end, and period along the tip
_BORE_RINGS = 5.2  # rings of a tube that are inside
_MARKS_MM = 6.0, 1.1, 0.14  # etched rings: their distance from each other, that of a pair, width


def unfold(profile: Floats, turn: int) -> Map:
    """Place (V, 2) in the texture of a closed bar's vertices (V, 3), from 0 to 1.

    `turn`: column of the texture's middle row.
    """
    rings = profile.reshape(-1, RING, 3)
    aside = (np.arange(RING) - turn + RING // 2) % RING - RING // 2  # columns from the middle one
    folded = np.where(np.abs(aside) > RING // 4, np.sign(aside) * RING // 2 - aside, aside)
    across = np.tile(_share_of_outline(rings[:, _shown(turn)])[RING // 4 - folded], len(rings))
    return np.column_stack([np.repeat(np.linspace(0, 1, len(rings)), RING), across]).astype(np.float32)


def wrap(points: Floats, outline: Floats) -> Map:
    """Place (V, 2), from 0 to 1, in the texture of round rings (R * RING, 3) mm of points (V, 3) mm in them.

    It is linear in z, as is the texture of rings at even distances, so that large faces fit too.
    """
    middles = outline.reshape(-1, RING, 3).mean(axis=1)
    x, y = (points[:, k] - np.interp(points[:, 2], middles[:, 2], middles[:, k]) for k in (0, 1))
    along = np.interp(points[:, 2], middles[:, 2], np.linspace(0, 1, len(middles)))
    return np.column_stack([along, 0.5 - np.arctan2(y, np.abs(x)) / np.pi]).astype(np.float32)


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
    height = int(np.clip(_WIDE_MM / mm_per_px, *_ACROSS))
    size = height, 4 * height
    if sheet_rows:
        grid = profile.reshape(sheet_rows, -1, 3)
        place, turned = _texels(grid, size), np.zeros(size, np.float32)
        sides = np.abs(grid[..., :2])
        inwards = (sides.max(axis=(0, 1)) - sides).min(axis=-1)
        along = _texels(inwards[..., None], size)
    else:
        rings = profile.reshape(-1, RING, 3)
        shown = _shown(turn)
        rows = np.interp(np.linspace(0, 1, height), _share_of_outline(rings[:, shown]), np.arange(len(shown)))
        place = _texels(rings[:, shown].swapaxes(0, 1), size, rows)
        turned = _texels(_edges(rings)[:, shown].T[..., None], size, rows)
        along = place[..., 2]
    wide = float(np.linalg.norm(place[-1] - place[0], axis=-1)[: size[1] // 3].max())
    blotch = noise(place, 8.0 if sheet_rows else max(2.5, 0.8 * wide), rng)
    mottle, grain = noise(place, 1.1, rng), noise(place, 0.35, rng)
    # Lines end where a bar narrows to its tip.
    width = np.linalg.norm(np.gradient(place, axis=0), axis=-1).sum(axis=0)
    fade = step(1.6 * width / width[: size[1] // 2].max() - 0.9)
    lines = grain if sheet_rows else fade * _lines(size, rng)
    worn = step((turned + 0.3 * blotch + 0.15 * grain - 1.5 * (1 - finish.wear)) / 0.4) * (finish.wear > 0)
    edge = step(turned - 0.8) * (not kind.startswith(("finger", *CLOTH)))
    coat = step((along - finish.bare_mm) / 0.06) * (1 - worn)
    bumps = 0.07 * step((along - finish.bare_mm) / 0.25) * (1 - worn) + 0.004 * coat * mottle
    bumps = bumps + 0.0012 * (1 - coat) * lines * (1 + 8 * finish.brushed)
    if kind == "spatula":  # no blade is flat
        bumps = bumps + _WARP * blotch * (1 - coat)

    rub = np.exp((0.25 + finish.brushed) * lines)
    rough = np.stack([finish.alpha * max(finish.streak, 1.0) * (1 - 0.2 * worn), finish.alpha * rub], axis=-1)
    rough[..., 1] *= 1 - 0.5 * np.maximum(edge, worn)
    base = (
        np.asarray(finish.mirror, np.float32) * (1 + 0.08 * np.maximum(worn, edge) + 0.03 * mottle)[..., None]
    )
    if kind in ("forceps", "bayonet"):
        start, end, period = _SERRATION_MM
        teeth = step((along - start) / 0.3) * step((end - along) / 0.6) * (1 - coat)
        across = np.abs(np.linspace(-1, 1, size[0], dtype=np.float32))[:, None]
        notch = (0.5 + 0.5 * np.cos(2 * np.pi * along / period)) ** 3 * teeth * step((across - 0.62) / 0.3)
        bumps, base = bumps - 0.06 * notch, base * (1 - 0.75 * notch[..., None])
    if kind in ("dissector", "suction"):
        every, apart, width = _MARKS_MM
        ring = np.mod(along - 0.5 * every, every)
        mark = (ridge(ring, width, 0.5) + ridge(ring, width, 0.5 + apart)) * (along > every) * (1 - coat)
        base, bumps = base * (1 - 0.6 * mark[..., None]), bumps - 0.02 * mark
    painted = np.asarray(finish.coat, np.float32) * np.clip(1 + 0.05 * mottle + 0.08 * lines, 0, 2)[..., None]
    base, bare = over(base, painted, coat[..., None]), (1 - coat) * (1 - finish.scattered)
    rough = over(rough, np.full(1, finish.coat_alpha, np.float32), coat[..., None])
    mirror = over(base, _PLASTIC, coat[..., None])

    # Blood: a film that is brightest red where it is thin, a clot where it is thick, a bead at its border.
    uneven = 0.45 * blotch + 0.3 * mottle + 0.1 * grain
    share = 2 * finish.blood - 0.4 - along / max(finish.blood_mm, 0.1) + uneven
    shown_to = step((1.3 * finish.blood_mm - along) / 2) * (finish.blood > 0)
    deep = np.clip(share / 0.9 + 0.2, 0, 1.4) * shown_to
    film, clot = step(deep / 0.15 - 0.5), 0.92 * step((deep - 0.75) / 0.5)
    base = over(through(base, deep + 0.25 * ridge(deep, 0.12, 0.12) * film, _FILM), _BLOOD, clot[..., None])
    bare = bare * (1 - clot)
    mirror = over(through(mirror, deep, _FILM), _PLASTIC, clot[..., None])
    bumps = bumps + 0.07 * step(deep / 0.35 - 0.5) + 0.02 * mottle * clot
    # Water: a wavy film on the tip, drops further up.
    wet = step((finish.wet_mm * (1 + 0.5 * blotch) - along) / 1.2 + 0.3 * mottle) * (finish.wet_mm > 0)
    drops = _drops(place, along, finish, rng)
    bumps = bumps + drops + 0.008 * wet * mottle
    wet = np.maximum.reduce([0.8 * wet, film, step(drops / 0.02 - 0.5)])
    if kind in CLOTH:
        wet = 0.3 * wet
    rough = over(
        rough, np.full(1, 0.1, np.float32), (0.6 * np.maximum(film, clot) * (kind not in CLOTH))[..., None]
    )
    if kind in ("suction", "tube"):
        bore = (np.linspace(0, 1, size[1]) * (len(profile) // RING - 1) < _BORE_RINGS)[None, :, None]
        base, mirror = base * np.where(bore, 0.06, 1), mirror * np.where(bore, 0.02, 1)
        bumps = np.where(bore[..., 0], 0, bumps)
    rough = np.clip(rough, 0.05, 1)
    rough[..., 0] = np.clip(rough[..., 0], rough[..., 1], rough[..., 1] / _LEAST)
    return FinishMaps(
        base=np.clip(base, 0.003, 0.98).astype(np.float32),
        bare=np.clip(bare, 0, 1).astype(np.float32),
        rough=rough.astype(np.float32),
        wet=np.clip(wet, 0, 1).astype(np.float32),
        mirror=np.clip(mirror, 0, 0.98).astype(np.float32),
        normal=_normals(bumps, place),
    )


def noise(at: Floats | Map, wave_mm: float, rng: np.random.Generator) -> Map:
    """Smooth noise (...) of unit variance at places (..., n) mm."""
    waves = rng.normal(size=(at.shape[-1], 16)) * 2 * np.pi / wave_mm
    phase = rng.uniform(0, 2 * np.pi, 16)
    angle = np.asarray(at, np.float32) @ waves.astype(np.float32) + phase.astype(np.float32)
    return np.asarray(np.cos(angle).sum(axis=-1) / np.float32(np.sqrt(8)), np.float32)


def _shown(turn: int) -> Indices:
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


def _lines(size: tuple[int, int], rng: np.random.Generator) -> Map:
    """Lines (h, w) along a part, each of some length, unit variance."""
    coarse = rng.normal(size=(size[0], 12)).astype(np.float32)
    lines = cv2.resize(coarse, size[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(lines / lines.std(), np.float32)


def _drops(place: Map, along: Map, finish: Finish, rng: np.random.Generator) -> Map:
    """Height (h, w) mm of drops of water on the first part of a bar."""
    high = np.zeros(along.shape, np.float32)
    if not finish.wet_mm:
        return high
    reach = np.flatnonzero((along[len(along) // 2] > 0.3) & (along[len(along) // 2] < 3 * finish.wet_mm))
    for _ in range(rng.poisson(2.5 * finish.wet_mm) if len(reach) else 0):
        row, column = rng.integers(len(along)), rng.choice(reach)
        radius = float(np.exp(rng.uniform(np.log(0.08), np.log(0.4))))
        near = np.flatnonzero(np.abs(along[row] - along[row, column]) < radius)
        away2 = ((place[:, near] - place[row, column]) ** 2).sum(axis=-1) / radius**2
        high[:, near] = np.maximum(high[:, near], 0.4 * radius * np.maximum(1 - away2, 0))
    return high


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
