"""Colour and microstructure of the cortex as maps over its patch, from the parenchyma up to the wet film.

Sizes are mm, albedos linear RGB; an absorption is the optical depth (natural) of red, green and blue for one
unit of the layer's depth map. All were chosen by eye on an intra-operative photograph
(`evidence.appearance` compares renderings with one).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np

from synth.arrays import Map
from synth.errors import UserError
from synth.geometry import triangles
from synth.render.anatomy import noise, tube
from synth.render.anatomy.chart import places
from synth.render.anatomy.layers import Rgb, attenuate, over, ridge, step
from synth.render.anatomy.surface import CortexSurface
from synth.render.appearance.family import Appearance
from synth.render.materials import Coat
from synth.system import checked_file

Tubes = dict[str, tuple[Map, Map]]
Random = np.random.Generator

_TEXELS_A_PIXEL = 2.2
_TILE = 512  # side of the map of the finest relief, which repeats
_SLOPES = 512  # side of the map of the mesh's slopes
_NARROW = 2  # exponent on the sulci's depth map, so that only clefts are dark and wet, not the slopes above


class Parenchyma:
    """Two tints in clouds, finely grained, under the blood of the pia and of vessels below the pia."""

    grain: Rgb = (0.5, 1.0, 1.2)  # of `appearance.grain`, in each channel
    pia: Rgb = (0.16, 1.0, 1.3)  # absorption
    perivascular: tuple[float, float] = 0.7, 1.1  # blur of arteries and of veins that redden the pia around
    deep: float = 0.16  # blur of vessels below the pia
    net: tuple[float, float] = (
        0.55,
        0.1,
    )  # of capillaries: wavelength, and width of its lines as a share of it
    blush: float = 0.16  # optical depth of such a line
    scatter: Rgb = (0.055, 0.032, 0.026)  # blur by light that travels in tissue, farthest in red


class Sulcus:
    """Grey fluid under hazy arachnoid with whiter strands; a cleft returns little light."""

    fluid: Rgb = (0.50, 0.50, 0.72)  # of the albedo of gyri
    strands: Rgb = (0.62, 0.52, 0.48)  # albedo
    dark: Rgb = (0.5, 0.75, 0.62)  # absorption
    depth: tuple[float, float] = 2.4, 1.8  # optical: by the sulcus's depth, and more beyond half of it


class Bleeding:
    """Blood on the pia: thin films drawn out over it; pairs are ranges."""

    films: float = 2.2  # mean number on a patch whose rim is soaked with blood
    radius: tuple[float, float] = 0.5, 1.8
    long: tuple[float, float] = 1.0, 2.6  # a film's length over its width
    depth: tuple[float, float] = 0.15, 0.6  # optical, of a film
    ragged: float = 0.8  # share of a film's radius by which noise shifts its border
    blood: Rgb = (0.12, 1.5, 2.4)  # absorption


class Artery:
    """Blood that absorbs most green light even in the finest arteries, and an opaque wall of wide ones."""

    absorption_per_mm: Rgb = (0.3, 3.6, 5.6)
    rosy: Rgb = (0.9, 4.4, 4.6)  # that of wide ones and of some stretches, under more of the arachnoid
    rosy_share: tuple[float, float, float] = 0.1, 0.55, 0.3  # of it: of fine ones, of wide ones more, spread
    opaque: tuple[float, float] = 0.3, 0.08  # depth that even fine ones reach, and the chord for 63% of it
    wall: Rgb = (0.8, 0.27, 0.16)  # albedo
    wide: tuple[float, float] = 0.1, 0.2  # radius of the first opaque walls, and span to fully opaque ones
    crossing: float = 0.9  # opacity of a wall over a vein, as a share of that of the widest artery's
    rim: tuple[float, float] = 0.95, 0.4  # of a wide one's radius: middle and width of its dark rims
    rim_dark: Rgb = (0.2, 0.6, 0.55)  # absorption
    covered: tuple[float, float] = 0.98, 0.3  # of its redness along it, by the arachnoid: mean, and spread


class Vein:
    """Dark red where thin and at the sides, bluish along a thick one's crest, in a dark margin of tissue."""

    thin: Rgb = (0.42, 0.11, 0.14)  # albedo
    wide: tuple[float, float] = 0.12, 0.3  # radius at which a vein begins to be thick, span to fully thick
    margin: float = 0.8  # blur
    margin_dark: Rgb = (0.36, 0.85, 0.62)  # absorption
    crest: float = 0.5  # of a thick one's radius: width of its bluish crest
    pale: Rgb = (0.66, 0.56, 0.66)  # albedo of the sheen along it, beside the highlight,
    gleam: tuple[float, float, float] = 0.2, 0.15, 0.34  # its share: mean, spread; its width in radii
    rim: tuple[float, float] = 0.9, 0.36  # of a thick one's radius: middle and width of its dark rims
    rim_dark: Rgb = (0.8, 1.15, 0.85)  # absorption
    mottle: float = 0.14  # standard deviation of its wall's albedo, as a share of it
    fibres: tuple[float, float] = 0.5, 0.045  # of its wall: wavelength, and contrast
    veil: Rgb = (0.60, 0.47, 0.42)  # albedo of the arachnoid over it,
    veiled: tuple[float, float, float] = 0.08, 0.12, 0.4  # share of it that shows: mean, spread, most
    deep: tuple[float, float] = 0.4, 0.4  # by how much less of it shows where it lies deeper; the least share
    sunk: float = 0.3  # height of a tube's middle below the pia, as a share of its radius
    shoulder: float = 0.14  # blur of its relief
    level: float = 0.97  # share by which a crest turns from the pia's slope to that which mirrors the lamp:
    # nearly all, so that the highlight never ends; the wall's long waves vary its width
    dry: tuple[float, float] = 0.8, 0.2  # share of a thick one's crest under a thin film: mean, and spread
    beside: tuple[float, float] = 0.85, 0.4  # that of the pia beside a thick one, and blur of where
    waves: float = 0.012  # standard deviation of the slopes of its wall's waves
    waves_mm: float = 0.16  # blur that makes them


class Film:
    """Fluid over everything: it climbs along vessels and at the rim, smooths finer relief, and undulates a
    little; in pools it lies level."""

    climb: float = 0.16  # of a vessel's radius
    climb_mm: float = 0.16  # distance over which that falls off
    reach_mm: tuple[float, float] = 0.12, 0.45  # where it ends, of the finest vessels and of wide ones
    thin: float = 4.6  # of a film's thinness where nothing wets, clipped below 0 in pools, above 1: mean,
    uneven: float = 1.5  # and spread
    swell_mm: float = 0.004  # standard deviation of the undulation
    rough: float = 0.05  # standard deviation of slopes where the film is thin
    level: float = 0.15  # share of the pia's slope that a pool takes away,
    filled: float = 0.6  # and of the relief under it
    ripples: float = 0.038  # standard deviation of its slopes: a level pool mirrors a lamp as one white patch
    ripples_mm: float = 0.3  # blur that makes them
    pool_mm: float = 0.35  # least size of a pool
    rim_mm: float = 0.3  # height that it climbs at the rim


def resolution(extent_mm: float, mm_per_px: float) -> int:
    """Side [texels] of a map that is as fine as the picture needs."""
    return int(np.clip(64 * round(extent_mm / mm_per_px * _TEXELS_A_PIXEL / 64), 128, 4096))


def cortex(
    surface: CortexSurface,
    appearance: Appearance,
    pixels: int,
    photo: Path | None,
    shade: Map | None = None,
    mirror: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Coat:
    """Maps of parenchyma, vessels and wet film over the surface's chart, `pixels` on a side.

    `photo`: a picture that replaces the painted albedo; `shade`: (m, m) share of light that the rim lets
    reach the surface; 1 if not given; `mirror`: slopes that mirror the main lamp into the lens, see
    `light.mirror_slopes`. UserError: the photograph cannot be read.
    """
    extent = surface.chart.extent_mm
    rng = np.random.default_rng([surface.seed, 2])
    vessels = surface.vessels
    trees = {"veins": vessels.visible_veins, "arteries": vessels.arteries, "deep": vessels.deep}
    # Fluid climbs along veins and arteries, along fine ones less far.
    finest, widest = Film.reach_mm
    margins = {name: np.clip(finest + tree.radius / 0.3, finest, widest) for name, tree in trees.items()}
    margins["deep"] = np.full(len(vessels.deep.radius), extent / pixels)
    tubes = {name: tube.raster(tree, pixels, extent, margins[name]) for name, tree in trees.items()}
    sulci = cv2.resize(surface.sulci**_NARROW, (pixels, pixels), interpolation=cv2.INTER_LINEAR)
    albedo = _photograph(photo, pixels) if photo else _paint_albedo(rng, appearance, tubes, sulci, extent)
    if shade is not None:
        red_least = np.array([0.7, 1.0, 1.0], np.float32)
        albedo = albedo * cv2.resize(shade, (pixels, pixels))[..., None] ** red_least
    height, dry, pools, vein_share = _film(rng, appearance, tubes, sulci, shade, extent)
    return Coat(albedo, normals(height, extent, _excess(surface, pools, vein_share, mirror)), dry)


def normals(height: Map, extent_mm: float, excess: Map | None = None) -> Map:
    """Unit normals (n, n, 3) of a height map (n, n) mm, less slopes (m, m, 2) that are interpolated."""
    pixel = extent_mm / height.shape[0]
    dx = cv2.Sobel(height, cv2.CV_32F, 1, 0, ksize=3, scale=1 / (8 * pixel))
    dy = cv2.Sobel(height, cv2.CV_32F, 0, 1, ksize=3, scale=1 / (8 * pixel))
    if excess is not None:
        slopes = cv2.resize(excess, height.shape[::-1], interpolation=cv2.INTER_LINEAR)
        dx, dy = dx - slopes[..., 0], dy - slopes[..., 1]
    z = 1 / np.sqrt(1 + dx * dx + dy * dy)
    return np.asarray(cv2.merge([-dx * z, -dy * z, z]), np.float32)


def thickness(vessel: tuple[Map, Map]) -> Map:
    """Vertical chord (n, n) mm through round vessels, from their distance and radius maps."""
    distance, radius = vessel
    return np.asarray(2 * np.sqrt(np.maximum(radius**2 - distance**2, 0)), np.float32)


def _paint_albedo(rng: Random, appearance: Appearance, tubes: Tubes, sulci: Map, extent: float) -> Map:
    pixels = len(sulci)
    clouds = noise.fractal(rng, 256, extent, 12.0, 2.4)
    mottle = noise.fractal(rng, 256, extent, 3.0, 1.3)
    pale_share = np.clip(0.62 + 0.42 * clouds + 0.04 * mottle, 0, 1)
    pale_share = cv2.resize(pale_share, (pixels, pixels), interpolation=cv2.INTER_CUBIC)[..., None]
    grain = noise.fractal(rng, min(pixels, 640), extent, 0.35, 1.2)
    grain = cv2.resize(grain, (pixels, pixels))
    chords = {name: thickness(vessel) for name, vessel in tubes.items()}
    perivascular = noise.blur(chords["arteries"], Parenchyma.perivascular[0], extent)
    perivascular = perivascular + noise.blur(chords["veins"], Parenchyma.perivascular[1], extent)
    bleeding = _bleedings(rng, appearance.blood, pixels, extent)
    mottle_texels = cv2.resize(mottle, (pixels, pixels))
    deep_mm = noise.blur(chords["deep"], Parenchyma.deep, extent)
    deep_mm = deep_mm + _net(rng, pixels, extent) / appearance.subpial_absorbance_per_mm
    tissue = [
        pale_share,
        grain,
        sulci,
        perivascular,
        mottle_texels,
        deep_mm,
        _strands(rng, sulci, extent),
        bleeding,
    ]
    veins = _vein_maps(rng, tubes["veins"], extent)
    cover = cv2.resize(noise.band(rng, 128, extent, 6.0, 0.6), (pixels, pixels))
    arteries = [cover, *tubes["arteries"]]
    (albedo,) = noise.map_rows(partial(_paint_rows, appearance), *tissue, *veins, *arteries)
    # Light that enters tissue leaves it nearby: a blur approximates the scattering volume.
    for channel, width in enumerate(Parenchyma.scatter):
        albedo[..., channel] = noise.blur(np.ascontiguousarray(albedo[..., channel]), width, extent)
    return np.asarray(np.clip(albedo, 0.01, 0.95, out=albedo), np.float32)


def _paint_rows(appearance: Appearance, *maps: Map) -> tuple[Map]:
    """Albedo (r, n, 3) of some rows of maps: 6 of tissue, strands, bleedings, 6 of veins, 3 of arteries."""
    tissue = _add_clefts(appearance, _parenchyma(appearance, *maps[:6]), sulci=maps[2], strands=maps[6])
    albedo = _add_veins(appearance, attenuate(tissue, maps[7], Bleeding.blood), *maps[8:14])
    crossing = maps[9] * step((0.85 - maps[8]) / 0.3)  # wide veins, over which arteries run
    return (_add_arteries(appearance, albedo, crossing, *maps[14:]),)


def _parenchyma(
    appearance: Appearance,
    pale_share: Map,
    grain: Map,
    sulci: Map,
    perivascular: Map,
    mottle: Map,
    deep_mm: Map,
) -> Map:
    """Albedo (r, n, 3) under the blood of the pia, most in sulci and around vessels, and of deep vessels.

    `pale_share`: share of the less perfused tint; `perivascular`, `deep_mm`: mm of blood.
    """
    tints = appearance.perfused_albedo, appearance.gyrus_albedo
    perfused, gyrus = (np.asarray(tint, np.float32) for tint in tints)
    albedo = over(perfused, gyrus, pale_share)
    albedo = albedo * (1 + appearance.grain * grain[..., None] * np.array(Parenchyma.grain, np.float32))
    blood = appearance.pial_absorbance * (0.04 + 0.8 * sulci) + (0.2 + 1.1 * sulci) * perivascular
    blood = blood * np.clip(1 + 0.3 * mottle, 0.2, 2) + appearance.subpial_absorbance_per_mm * deep_mm
    return attenuate(albedo, blood, Parenchyma.pia)


def _add_clefts(appearance: Appearance, albedo: Map, sulci: Map, strands: Map) -> Map:
    """Albedo (r, n, 3) with fluid, haze and strands of arachnoid over the deepest sulci, darkened there."""
    haze = np.clip(0.45 * np.clip((sulci - 0.45) / 0.4, 0, 1) + 0.35 * strands, 0, 0.7)[..., None]
    fluid = np.array(appearance.gyrus_albedo, np.float32) * np.array(Sulcus.fluid, np.float32)
    haze_colour = fluid + strands[..., None] * (np.array(Sulcus.strands, np.float32) - fluid)
    albedo = albedo + haze * appearance.sulcus_shading * (haze_colour - albedo)
    depth = Sulcus.depth[0] * sulci + Sulcus.depth[1] * np.clip(sulci - 0.5, 0, 1)
    return attenuate(albedo, appearance.sulcus_shading * depth, Sulcus.dark)


def _strands(rng: Random, sulci: Map, extent: float) -> Map:
    """Share (n, n) covered by the arachnoid's fibres over clefts: thin lines."""
    side = 384
    wave = noise.band(rng, side, extent, 1.6, 0.4)
    slope = np.hypot(*np.gradient(wave, extent / side)).astype(np.float32)
    line = ridge(wave / np.maximum(slope, 0.5), width=0.07)
    cleft_share = np.clip((cv2.resize(sulci, (side, side)) - 0.5) / 0.3, 0, 1)
    return np.asarray(cv2.resize((line * cleft_share).astype(np.float32), sulci.shape[::-1]), np.float32)


def _net(rng: Random, pixels: int, extent: float) -> Map:
    """Optical depth (n, n) of a net of the finest vessels, denser in some places."""
    side = min(pixels, 768)
    wave, width = Parenchyma.net
    line = ridge(noise.band(rng, side, extent, wave, 0.35), 2 * np.pi * width)
    density = np.clip(0.6 + 0.5 * noise.band(rng, 96, extent, 5.0, 0.5), 0, 1.4)
    depth = Parenchyma.blush * line * cv2.resize(density, (side, side))
    return np.asarray(cv2.resize(depth.astype(np.float32), (pixels, pixels)), np.float32)


def _bleedings(rng: Random, blood: float, pixels: int, extent: float) -> Map:
    """Optical depth (n, n) of a few films of blood, thickest in the middle, thin at a ragged border."""
    side = 384
    axis = noise.centres(side, extent)
    border_noise = noise.fractal(rng, side, extent, 2.5, 2.2)
    total = np.zeros((side, side), np.float32)
    for _ in range(rng.poisson(Bleeding.films * blood)):
        (x, y), turn = rng.uniform(-0.4, 0.4, 2) * extent, rng.uniform(0, np.pi)
        least, most = Bleeding.radius
        radius = least * (most / least) ** rng.random()
        elongation = rng.uniform(*Bleeding.long) ** 0.5
        u, v = axis[None] - x, axis[:, None] - y
        along, aside = np.cos(turn) * u + np.sin(turn) * v, np.cos(turn) * v - np.sin(turn) * u
        distance = np.hypot(along / elongation, aside * elongation) / radius
        inside = np.clip((1 - distance + Bleeding.ragged * border_noise) / 0.8, 0, 1.3)
        film = inside * step((1.6 - distance) / 0.5)
        total += (rng.uniform(*Bleeding.depth) * film).astype(np.float32)
    return np.asarray(cv2.resize(total, (pixels, pixels), interpolation=cv2.INTER_CUBIC), np.float32)


def _vein_maps(rng: Random, vessel: tuple[Map, Map], extent: float) -> list[Map]:
    """The maps (n, n) of `_add_veins`."""
    distance, radius = vessel
    size = distance.shape
    across = np.asarray(np.clip(distance / np.maximum(radius, 1e-3), 0, 1), np.float32)
    start, span = Vein.wide
    thick_share = np.clip((radius - start) / span, 0, 1)
    mottle = 0.8 * noise.band(rng, 96, extent, 9.0, 0.6) + 0.6 * noise.band(rng, 96, extent, 2.4, 0.5)
    along = cv2.resize(mottle, size)
    fibres = cv2.resize(noise.band(rng, 384, extent, Vein.fibres[0], 0.5), size)
    cover = noise.blur(np.clip((1 - across**2) * (2.2 - thick_share), 0, 1).astype(np.float32), 0.09, extent)
    margin = noise.blur(((across < 1) * thick_share).astype(np.float32), Vein.margin, extent)
    return [across, thick_share, along, fibres, cover, margin]


def _add_veins(appearance: Appearance, albedo: Map, *maps: Map) -> Map:
    """Albedo (r, n, 3) of some rows with their veins, by the maps of `_vein_maps`."""
    across, thick_share, along, fibres, cover, margin = maps
    crest = (np.clip(0.6 + 0.3 * along, 0.1, 1) * thick_share * ridge(across, width=Vein.crest))[..., None]
    thin_colour = np.array(Vein.thin, np.float32) + 0.06 * along[..., None]
    side = over(thin_colour, np.asarray(appearance.vein_side_albedo, np.float32), thick_share[..., None])
    wall = over(side, np.asarray(appearance.vein_crest_albedo, np.float32), crest)
    mean, spread, width = Vein.gleam
    gleam = np.clip(mean - spread * along, 0, 0.8) * thick_share * ridge(across, width=width)
    wall = over(wall, np.array(Vein.pale, np.float32), gleam[..., None])
    middle, width = Vein.rim
    wall = wall * (1 + Vein.mottle * along + Vein.fibres[1] * fibres)[..., None]
    wall = attenuate(wall, thick_share * ridge(across, width=width, centre=middle), Vein.rim_dark)
    # Some stretches lie deeper, under the arachnoid, which is milky in places.
    mean, spread, most = Vein.veiled
    veil_share = np.clip(mean - spread * along + 0.02 * fibres, 0, most) * thick_share
    wall = over(wall, np.array(Vein.veil, np.float32), veil_share[..., None])
    loss, least_cover = Vein.deep
    cover = (cover * np.clip(0.95 + loss * np.minimum(along + 0.5, 0), least_cover, 0.97))[..., None]
    return np.asarray(over(attenuate(albedo, 1.7 * margin, Vein.margin_dark), wall, cover), np.float32)


def _add_arteries(
    appearance: Appearance, albedo: Map, crossing: Map, cover: Map, distance: Map, radius: Map
) -> Map:
    """Albedo (r, n, 3) of some rows with their arteries, in a red that varies with the noise `cover`; where
    dark veins are `crossing`, only their walls are seen."""
    chord = thickness((distance, radius))
    most, scale = Artery.opaque
    blood_depth = most * (1 - np.exp(-chord / scale)) + 0.08 * chord
    mean, spread = Artery.covered
    fade = np.clip(mean + spread * cover, 0.35, 1.2)
    # The wall of a wide artery scatters light itself, most along the crest.
    start, span = Artery.wide
    thick_share = np.maximum(np.clip((radius - start) / span, 0, 1), Artery.crossing * crossing) * (
        distance < radius
    )
    fine_share, rise, rosy_spread = Artery.rosy_share
    rosy_share = np.clip(fine_share + rise * thick_share - rosy_spread * cover, 0, 1)[..., None]
    orange, rose = (np.array(blood, np.float32) for blood in (Artery.absorption_per_mm, Artery.rosy))
    depth = (appearance.arterial_absorption * blood_depth * fade)[..., None]
    colour = albedo * np.exp(-depth * (orange + rosy_share * (rose - orange)))
    across = distance / np.maximum(radius, 1e-3)
    wall = np.array(Artery.wall, np.float32) * (0.7 + 0.4 * ridge(across, width=0.55))[..., None]
    blend = colour + (0.55 * thick_share * np.clip(fade, 0, 1))[..., None] * (wall - colour)
    middle, width = Artery.rim
    return np.asarray(
        attenuate(blend, thick_share * ridge(across, width, middle), Artery.rim_dark), np.float32
    )


def _film(
    rng: Random, appearance: Appearance, tubes: Tubes, sulci: Map, shade: Map | None, extent: float
) -> tuple[Map, Map, Map, Map]:
    """Height of the wet surface above the pia [mm], the share of it under too thin a film, and the shares of
    pools and of veins."""
    side = 256
    distance, radius = tubes["veins"]
    tube_height = np.sqrt(np.maximum(radius**2 - distance**2, 0)) - Vein.sunk * radius
    veins = noise.blur(np.maximum(tube_height, 0).astype(np.float32), Vein.shoulder, extent)
    relief = 0.14 * thickness(tubes["arteries"]) + _meniscus(tubes["arteries"]) + _meniscus(tubes["veins"])
    relief = noise.blur(relief, appearance.fluid_smoothing_mm, extent)
    unevenness = noise.fractal(rng, side, extent, 5.0, 1.5)
    # Fluid lies in pools, in sulci and along arteries; elsewhere the film mirrors next to nothing.
    blood = thickness(tubes["arteries"])
    nearby_blood = noise.blur(cv2.resize(blood, (side, side), interpolation=cv2.INTER_AREA), 0.25, extent)
    wetness = 0.7 * cv2.resize(sulci, (side, side)) + 2.4 * np.minimum(nearby_blood, 0.25)
    wetness = wetness + 1.6 * appearance.light.glare
    if shade is not None:
        edge = cv2.resize(1 - shade, (side, side), interpolation=cv2.INTER_AREA)
        wetness = wetness + 2.0 * edge
        relief = (
            relief + Film.rim_mm * cv2.resize(1 - shade, sulci.shape, interpolation=cv2.INTER_LINEAR) ** 2
        )
    thinness = Film.thin + Film.uneven * unevenness - 3 * wetness
    dry = np.clip(thinness, 0.05, 0.85)
    pools = np.clip(1.6 * noise.blur((0.9 - thinness).astype(np.float32), Film.pool_mm, extent), 0, 1)
    dry = np.minimum(dry, 1 - pools)
    swell = noise.band(rng, side, extent, 2.2, 0.5) * Film.swell_mm * (1 - 0.2 * pools)
    swell = cv2.resize(swell, sulci.shape, interpolation=cv2.INTER_CUBIC)
    pool_share = cv2.resize(pools, sulci.shape, interpolation=cv2.INTER_LINEAR)
    relief = relief * (1 - Film.filled * pool_share) + veins
    # A vein's wall is smooth, and its film thin: its crest mirrors the lamp in one broad line.
    on_vein = noise.blur((distance < radius).astype(np.float32), 0.1, extent)
    height = relief + appearance.bump * (1 - 0.9 * on_vein) * swell
    roughness = cv2.resize(dry.astype(np.float32), sulci.shape, interpolation=cv2.INTER_LINEAR) * (
        1 - on_vein
    )
    tile = rng.standard_normal((_TILE, _TILE), np.float32)
    fine = np.tile(tile, (len(sulci) // _TILE + 1,) * 2)[: len(sulci), : len(sulci)]
    height = height + (Film.rough * extent / len(sulci)) * roughness * fine
    start, span = Vein.wide
    wide_share = on_vein * np.clip((radius - start) / span, 0, 1)
    height = height + wide_share * _waves(tile, Vein.waves, Vein.waves_mm, extent, len(sulci))
    ripples = _waves(tile.T, Film.ripples, Film.ripples_mm, extent, len(sulci))
    height = height + (0.55 + 0.45 * pool_share) * (1 - on_vein) * ripples
    vein_share, wide_share = (
        cv2.resize(share, (side, side), interpolation=cv2.INTER_AREA) for share in (on_vein, wide_share)
    )
    # Beside wide veins it would shine in beads where the wall meets the pia.
    most, reach = Vein.beside
    dry = np.maximum(dry, most * np.clip(4 * noise.blur(wide_share, reach, extent), 0, 1))
    mean, spread = Vein.dry
    dry = over(dry, np.clip(mean + spread * noise.band(rng, side, extent, 3.0, 0.6), 0.1, 1), vein_share)
    return np.asarray(height, np.float32), np.asarray(np.clip(dry, 0, 1), np.float32), pools, wide_share


def _waves(tile: Map, slope: float, blur_mm: float, extent: float, pixels: int) -> Map:
    """Heights (n, n) mm of waves with slopes of a standard deviation: white noise that repeats, blurred."""
    sigma = blur_mm * pixels / extent
    blurred = cv2.GaussianBlur(np.pad(tile, 64, mode="wrap"), (0, 0), sigma)[64:-64, 64:-64]
    heights = slope * blur_mm * 2**0.5 / float(blurred.std()) * blurred
    return np.tile(heights, (pixels // _TILE + 1,) * 2)[:pixels, :pixels]


def _excess(surface: CortexSurface, pools: Map, vein_share: Map, mirror: tuple[float, float, float]) -> Map:
    """Slopes (m, m, 2) of the mesh that the wet surface lacks: of veins, which are drawn finer than the mesh
    resolves, of the pia in `pools` (k, k), and under veins (k, k) less those of `mirror`, see `cortex`."""
    side = len(surface.pia)
    pia = surface.vertices.copy()
    pia[:, 2] = surface.pia.ravel()
    mesh_normals = [
        triangles.normals(triangles.Shape(points, surface.faces)) for points in (surface.vertices, pia)
    ]
    veined_slopes, pia_slopes = (-normal[:, :2] / normal[:, 2:] for normal in mesh_normals)
    shares = np.stack([Film.level * pools, Vein.level * vein_share], axis=-1).astype(np.float32)
    pool_level, vein_level = noise.sample(shares, surface.uv.astype(np.float64) - 0.5, 1.0).T[..., None]
    mirror_slopes = np.asarray(mirror[:2]) + mirror[2] * surface.vertices[:, :2]
    missing = pool_level * (1 - vein_level) * pia_slopes + vein_level * (pia_slopes - mirror_slopes)
    slopes = (veined_slopes - pia_slopes + missing).astype(np.float32).reshape(side, side, 2)
    texels = places(surface.chart, _SLOPES)
    return noise.sample(slopes, texels, surface.extent_mm * side / (side - 1)).reshape(_SLOPES, _SLOPES, 2)


def _meniscus(vessel: tuple[Map, Map]) -> Map:
    """Height (n, n) mm of the fluid that climbs along vessels; none on a vessel's crest."""
    distance, radius = vessel
    gap = distance - radius
    falloff = np.where(gap > 0, Film.climb_mm, np.maximum(0.3 * radius, 1e-3))
    return np.asarray(Film.climb * np.minimum(radius, 0.45) * np.exp(-np.abs(gap) / falloff), np.float32)


def _photograph(path: Path, pixels: int) -> Map:
    """The middle square of a photograph as linear albedo."""
    try:
        image = checked_file.read_picture(path)
    except UserError as error:
        raise UserError(f"appearance.photo: {error}") from None
    side = min(image.shape[:2])
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    square = image[top : top + side, left : left + side]
    square = cv2.resize(square, (pixels, pixels), interpolation=cv2.INTER_AREA)
    srgb = square[..., ::-1].astype(np.float32) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    # A map's first row has the lowest y.
    return np.asarray(np.clip(linear[::-1], 0.01, 0.95), np.float32)
