"""Colour and microstructure of the cortex as maps over its patch."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from synth.errors import UserError
from synth.render.anatomy import noise, tube
from synth.render.anatomy.surface import CortexSurface
from synth.render.appearance.look import Look
from synth.render.mitsuba.adapter import Coat
from synth.system import checked_file
from synth.system.jit import vectorised

Map = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

# Light lost in a millimetre of vessel, red, green, blue: blood seen through its wall, by eye on photographs.
_ARTERIAL = np.array([0.4, 5.6, 7.6], np.float32)
_TEXELS_A_PIXEL = 2.2
_NARROW = 2  # power of the sulci's depth that is dark and wet: little is left a millimetre beside a cleft
_BLEEDINGS = 3.5  # on a patch where the rim is soaked with blood
_HAZE_MM = 0.8
_CLIMB = 0.16  # of a vessel's radius, which the film climbs beside it
_CLIMB_MM = 0.16  # over which that falls off


def resolution(extent_mm: float, mm_per_px: float) -> int:
    """Side of a map fine enough for the picture, and no finer."""
    return int(np.clip(64 * round(extent_mm / mm_per_px * _TEXELS_A_PIXEL / 64), 128, 4096))


def cortex(
    surface: CortexSurface, look: Look, pixels: int, photo: Path | None, shade: Map | None = None
) -> Coat:
    """Parenchyma, vessels and wet film over the surface's chart.

    Args:
        surface: the cortex.
        look: its appearance.
        pixels: side of the maps.
        photo: a picture that takes the place of the painted albedo.
        shade: (m, m) share of light that reaches the surface past what frames it; all of it if not given.

    Raises:
        UserError: the photograph cannot be read.
    """
    extent = surface.chart.extent_mm
    rng = np.random.default_rng([surface.seed, 2])
    tubes = {
        name: tube.raster(getattr(surface.vessels, name), pixels, extent)
        for name in ("veins", "arteries", "deep")
    }
    # Light and blood tell the clefts from the slopes above them.
    sulci = cv2.resize(surface.sulci**_NARROW, (pixels, pixels), interpolation=cv2.INTER_LINEAR)
    albedo = _photograph(photo, pixels) if photo else _painted(rng, look, sulci, tubes, pixels, extent)
    if shade is not None:
        albedo = albedo * cv2.resize(shade, (pixels, pixels))[..., None] ** np.array(
            [0.7, 1.0, 1.0], np.float32
        )
    height, dry = _film(rng, look, tubes, sulci, pixels, extent)
    return Coat(albedo, normals(height, extent), dry)


def normals(height: Map, extent_mm: float) -> Map:
    """Unit normals (n, n, 3) of a height map (n, n) mm."""
    pixel = extent_mm / height.shape[0]
    dx = cv2.Sobel(height, cv2.CV_32F, 1, 0, ksize=3, scale=1 / (8 * pixel))
    dy = cv2.Sobel(height, cv2.CV_32F, 0, 1, ksize=3, scale=1 / (8 * pixel))
    found = np.empty((*height.shape, 3), np.float32)
    _tilt(dx, dy, found)
    return found


@vectorised
def _tilt(dx: Map, dy: Map, normal: Map) -> None:
    """Unit normals (n, n, 3) of slopes dx, dy (n, n)."""
    one = np.float32(1)
    for y in range(dx.shape[0]):
        for x in range(dx.shape[1]):
            a, b = dx[y, x], dy[y, x]
            length = np.sqrt(one + a * a + b * b)
            normal[y, x, 0], normal[y, x, 1], normal[y, x, 2] = -a / length, -b / length, one / length


def thickness(tube: tuple[Map, Map]) -> Map:
    """Chord through a round vessel, seen from above, (n, n) mm, of its distance and radius maps."""
    distance, radius = tube
    return np.asarray(2 * np.sqrt(np.maximum(radius**2 - distance**2, 0)), np.float32)


def _painted(
    rng: np.random.Generator,
    look: Look,
    sulci: Map,
    tubes: dict[str, tuple[Map, Map]],
    pixels: int,
    extent: float,
) -> Map:
    coarse = 256
    wide = noise.fractal(rng, coarse, extent, 12.0, 2.4)
    mottle = noise.fractal(rng, coarse, extent, 3.0, 1.3)
    share = np.clip(0.62 + 0.42 * wide + 0.04 * mottle, 0, 1)
    share = cv2.resize(share, (pixels, pixels), interpolation=cv2.INTER_CUBIC)[..., None]
    grain = noise.fractal(rng, pixels, extent, 0.35, 1.2)
    # Blood in the pia: more of it in the sulci and beside arteries.
    beside = noise.blur(thickness(tubes["arteries"]), 0.7, extent)
    beside = beside + noise.blur(thickness(tubes["veins"]), 1.1, extent)
    spots = _bleedings(rng, look, pixels, extent)
    even = cv2.resize(mottle, (pixels, pixels))
    deep = noise.blur(thickness(tubes["deep"]), 0.16, extent)
    tissue = [share, grain, sulci, beside, even, deep, _strands(rng, sulci, extent), spots]
    veins = _vein_maps(rng, tubes["veins"], extent)
    arteries = [cv2.resize(wide, (pixels, pixels)), *tubes["arteries"]]
    (albedo,) = noise.in_rows(partial(_paint_rows, look), *tissue, *veins, *arteries)
    # Light that enters tissue leaves it nearby, red farthest: a blur stands in for the volume.
    for channel, width in enumerate((0.055, 0.032, 0.026)):
        albedo[..., channel] = noise.blur(np.ascontiguousarray(albedo[..., channel]), width, extent)
    return np.asarray(np.clip(albedo, 0.01, 0.95, out=albedo), np.float32)


def _paint_rows(look: Look, *maps: Map) -> tuple[Map]:
    """Albedo (r, n, 3) of some rows, of the 8 maps of `_blushed`, 7 of `_veined` and 3 of `_arterial`."""
    return (_arterial(look, _veined(look, _blushed(look, *maps[:8]), *maps[8:15]), *maps[15:]),)


def _blushed(look: Look, *maps: Map) -> Map:
    """Albedo (r, n, 3) of some rows without the vessels of the pia.

    `deep`: blood that lies under it [mm]; `strands`: share of arachnoid that bridges; `spots`: spilt blood.
    """
    share, grain, sulci, beside, mottle, deep, strands, spots = maps
    albedo = np.asarray(look.crown, np.float32) * share + np.asarray(look.flush, np.float32) * (1 - share)
    albedo = albedo * (1 + look.grain * grain[..., None] * np.array([0.5, 1.0, 1.2], np.float32))
    blush = look.blush * (0.04 + 0.8 * sulci) + (0.32 + 1.1 * sulci) * beside
    blush = blush * np.clip(1 + 0.3 * mottle, 0.2, 2) + look.capillary * deep
    albedo = albedo * np.exp(-blush[..., None] * np.array([0.16, 1.0, 1.3], np.float32))
    # Fluid stands in the clefts: over the deepest it is grey, and the arachnoid a haze with whiter strands.
    haze = np.clip(0.45 * np.clip((sulci - 0.45) / 0.4, 0, 1) + 0.35 * strands, 0, 0.7)[..., None]
    fluid = np.array(look.crown, np.float32) * np.array([0.50, 0.50, 0.72], np.float32)
    milk = fluid + strands[..., None] * (np.array([0.62, 0.52, 0.48], np.float32) - fluid)
    albedo = albedo + haze * look.shade * (milk - albedo)
    # Little light comes back out of them.
    cleft = look.shade * (2.4 * sulci + 1.8 * np.clip(sulci - 0.5, 0, 1))
    albedo = albedo * np.exp(-cleft[..., None] * np.array([0.5, 0.75, 0.62], np.float32))
    return np.asarray(albedo * np.exp(-spots[..., None] * np.array([0.12, 1.5, 2.3], np.float32)))


def _strands(rng: np.random.Generator, sulci: Map, extent: float) -> Map:
    """Share (n, n) of the arachnoid's fibres where it bridges a cleft: thin lines, most of them across it."""
    small = 512
    wave = noise.band(rng, small, extent, 1.6, 0.4)
    slope = np.hypot(*np.gradient(wave, extent / small)).astype(np.float32)
    line = np.exp(-((wave / np.maximum(slope, 0.5) / 0.07) ** 2))
    over = np.clip((cv2.resize(sulci, (small, small)) - 0.5) / 0.3, 0, 1)
    return np.asarray(cv2.resize((line * over).astype(np.float32), sulci.shape[::-1]), np.float32)


def _bleedings(rng: np.random.Generator, look: Look, pixels: int, extent: float) -> Map:
    """Optical depth (n, n) of a few small bleedings under the arachnoid, ragged and thin at their edges."""
    small = 512
    axis = noise.centres(small, extent)
    ragged = noise.fractal(rng, small, extent, 2.5, 1.7)
    total = np.zeros((small, small), np.float32)
    for _ in range(int(rng.poisson(_BLEEDINGS * look.blood))):
        x, y = rng.uniform(-0.4, 0.4, 2) * extent
        radius, depth = rng.uniform(0.4, 1.6), rng.uniform(0.3, 0.9)
        away = np.hypot(axis[None] - x, axis[:, None] - y) / radius
        total += depth * np.clip(1.25 - away + 0.3 * ragged, 0, 1).astype(np.float32)
    return np.asarray(cv2.resize(total, (pixels, pixels), interpolation=cv2.INTER_CUBIC), np.float32)


def _arterial(look: Look, albedo: Map, wide: Map, distance: Map, radius: Map) -> Map:
    """Albedo (r, n, 3) of some rows with their arteries."""
    arterial = thickness((distance, radius))
    # Even the finest stop much of the green: blood is nearly opaque to it within a tenth of a millimetre.
    reach = 0.30 * (1 - np.exp(-arterial / 0.16)) + 0.08 * arterial
    fade = np.clip(0.95 + 0.25 * wide, 0.4, 1.2)
    red = albedo * np.exp(-(look.arterial * reach * fade)[..., None] * _ARTERIAL)
    # A wide one hides what is under it: its wall scatters light of its own, most along the crest.
    thick = np.clip((radius - 0.16) / 0.24, 0, 1) * (distance < radius)
    crest = np.exp(-((distance / np.maximum(0.7 * radius, 1e-3)) ** 2))
    wall = np.array([0.7, 0.13, 0.075], np.float32) * (0.78 + 0.27 * crest)[..., None]
    return np.asarray(red + (0.55 * thick)[..., None] * (wall - red), np.float32)


def _vein_maps(rng: np.random.Generator, tube: tuple[Map, Map], extent: float) -> list[Map]:
    """What `_veined` paints by, each (n, n)."""
    distance, radius = tube
    size = distance.shape
    across = np.asarray(np.clip(distance / np.maximum(radius, 1e-3), 0, 1), np.float32)
    thick = np.clip((radius - 0.12) / 0.3, 0, 1)
    along = cv2.resize(noise.band(rng, 256, extent, 9.0, 0.6), size)
    streak = cv2.resize(noise.fractal(rng, 1024, extent, 1.5, 1.0), size)
    cover = noise.blur(np.clip((1 - across**2) * (2.2 - thick), 0, 1).astype(np.float32), 0.05, extent)
    # The light that a vein takes is missed in the haze over its cleft, for about a millimetre.
    halo = noise.blur(((across < 1) * thick).astype(np.float32), _HAZE_MM, extent)
    # Not every stretch lies on the surface: some shimmer through the arachnoid.
    depth = cv2.resize(noise.band(rng, 256, extent, 7.0, 0.6), size)
    return [across, thick, along, streak, cover, halo, depth]


def _veined(look: Look, albedo: Map, *maps: Map) -> Map:
    """Albedo (r, n, 3) of some rows with their veins.

    Wine red where thin or seen at their sides, slate along the crest, here more and there less.
    """
    across, thick, along, streak, cover, halo, depth = maps
    slate = np.clip(0.55 + 0.4 * along, 0.08, 1) * thick * np.exp(-((across / 0.55) ** 2))
    slate = np.clip(slate * (1 + 0.12 * streak), 0, 1)[..., None]
    thin = np.array([0.50, 0.13, 0.15], np.float32) + 0.06 * along[..., None]
    wine = np.asarray(look.wine, np.float32) * thick[..., None] + thin * (1 - thick[..., None])
    wall = np.asarray(look.vein, np.float32) * slate + wine * (1 - slate)
    soft = albedo * np.exp(-1.7 * halo[..., None] * np.array([0.45, 1.0, 0.75], np.float32))
    cover = cover[..., None] * np.clip(0.9 + 0.15 * depth, 0.5, 0.97)[..., None]
    return np.asarray(soft * (1 - cover) + wall * cover, np.float32)


def _film(
    rng: np.random.Generator,
    look: Look,
    tubes: dict[str, tuple[Map, Map]],
    sulci: Map,
    pixels: int,
    extent: float,
) -> tuple[Map, Map]:
    """Height of the wet surface above the mesh, and where its film is thin, 0 to 1.

    The film evens out what is finer than itself; it gathers in sulci and leaves crowns and veins bare.
    """
    coarse = 512

    def fine(image: Map) -> Map:
        return np.asarray(cv2.resize(image, (pixels, pixels), interpolation=cv2.INTER_CUBIC), np.float32)

    relief = 0.14 * thickness(tubes["arteries"]) + _meniscus(tubes["arteries"]) + _meniscus(tubes["veins"])
    relief = noise.blur(relief, look.film_mm, extent)
    pools = noise.fractal(rng, coarse, extent, 5.0, 1.5)
    # It lies in pools, in sulci and beside vessels; what is left of it elsewhere mirrors next to nothing.
    blood = thickness(tubes["arteries"]) + thickness(tubes["veins"])
    beside = noise.blur(cv2.resize(blood, (coarse, coarse), interpolation=cv2.INTER_AREA), 0.25, extent)
    wet = 0.9 * cv2.resize(sulci, (coarse, coarse)) + 3.2 * np.minimum(beside, 0.25) + 1.6 * look.light.glare
    dry = np.clip(3.8 + 1.5 * pools - 3 * wet, 0.05, 1.0)
    swell = fine(noise.band(rng, coarse, extent, 2.2, 0.5) * 0.004)
    # The wall of a vein is taut and smooth: its crest mirrors the lamp in one line.
    distance, radius = tubes["veins"]
    on_vein = noise.blur((distance < radius).astype(np.float32), 0.1, extent)
    height = relief + look.bump * (1 - 0.9 * on_vein) * swell
    bare = dry * (1 - cv2.resize(on_vein, (coarse, coarse), interpolation=cv2.INTER_AREA))
    return np.asarray(height, np.float32), np.asarray(np.clip(bare, 0, 1), np.float32)


def _meniscus(tube: tuple[Map, Map]) -> Map:
    """Height (n, n) mm of the fluid that climbs beside vessels; none on a vessel's crest."""
    distance, radius = tube
    beyond = distance - radius
    steep = np.where(beyond > 0, _CLIMB_MM, np.maximum(0.3 * radius, 1e-3))
    return np.asarray(_CLIMB * np.minimum(radius, 0.45) * np.exp(-np.abs(beyond) / steep), np.float32)


def _photograph(path: Path, pixels: int) -> Map:
    """The middle square of a photograph as linear albedo."""
    try:
        image = checked_file.read_picture(path)
    except UserError as error:
        raise UserError(f"appearance.photo: {error}") from None
    side = min(image.shape[:2])
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    square = cv2.resize(
        image[top : top + side, left : left + side], (pixels, pixels), interpolation=cv2.INTER_AREA
    )
    encoded = square[..., ::-1].astype(np.float32) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    # First row of a map is the lower y.
    return np.asarray(np.clip(linear[::-1], 0.01, 0.95), np.float32)
