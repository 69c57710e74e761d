"""Colour and microstructure of the cortex as maps over its patch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from synth.errors import UserError
from synth.render import noise, vessels
from synth.render.anatomy import Surface
from synth.render.look import Look

Map = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

# Light lost in a millimetre of vessel, red, green, blue: blood seen through its wall, by eye on photographs.
_ARTERIAL = np.array([1.25, 8.0, 8.6], np.float32)
_TEXELS_A_PIXEL = 2.2


@dataclass(frozen=True)
class Coat:
    """What one body of wet tissue looks like."""

    albedo: Map
    """(n, n, 3) linear."""
    normal: Map
    """(n, n, 3)."""


def resolution(extent_mm: float, mm_per_px: float) -> int:
    """Side of a map fine enough for the picture, and no finer."""
    return int(np.clip(64 * round(extent_mm / mm_per_px * _TEXELS_A_PIXEL / 64), 128, 4096))


def cortex(surface: Surface, look: Look, pixels: int, photo: Path | None) -> Coat:
    """Parenchyma, vessels and wet film over the surface's patch."""
    extent = surface.extent_mm
    rng = np.random.default_rng([surface.seed, 2])
    tubes = {
        name: vessels.raster(getattr(surface.vessels, name), pixels, extent)
        for name in ("veins", "arteries", "capillaries")
    }
    sulci = cv2.resize(surface.sulci, (pixels, pixels), interpolation=cv2.INTER_LINEAR)
    albedo = _photograph(photo, pixels) if photo else _painted(rng, look, sulci, tubes, pixels, extent)
    height = _film(rng, look, tubes, pixels, extent)
    return Coat(albedo, normals(height, extent))


def normals(height: Map, extent_mm: float) -> Map:
    """Unit normals (n, n, 3) of a height map (n, n) mm."""
    pixel = extent_mm / height.shape[0]
    dx = cv2.Sobel(height, cv2.CV_32F, 1, 0, ksize=3, scale=1 / (8 * pixel))
    dy = cv2.Sobel(height, cv2.CV_32F, 0, 1, ksize=3, scale=1 / (8 * pixel))
    length = np.sqrt(1 + dx * dx + dy * dy)
    return np.stack([-dx / length, -dy / length, 1 / length], axis=-1).astype(np.float32)


def thickness(tube: tuple[Map, Map]) -> Map:
    """Length of the chord through a round vessel, seen from above [mm]."""
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
    wide = noise.fractal(rng, coarse, extent, 12.0, 2.0)
    mottle = noise.fractal(rng, coarse, extent, 3.0, 1.3)
    share = np.clip(0.5 + 0.42 * wide + 0.12 * mottle, 0, 1)
    share = cv2.resize(share, (pixels, pixels), interpolation=cv2.INTER_CUBIC)[..., None]
    albedo = np.asarray(look.crown, np.float32) * share + np.asarray(look.flush, np.float32) * (1 - share)
    grain = noise.fractal(rng, pixels, extent, 0.35, 1.2)
    albedo = albedo * (1 + look.grain * grain[..., None] * np.array([0.5, 1.0, 1.2], np.float32))
    # Blood in the pia: more of it in the sulci and beside arteries.
    arterial = thickness(tubes["arteries"])
    blush = 1.6 * noise.blur(arterial, 0.5, extent) + look.blush * (0.05 + 0.25 * sulci)
    blush = blush * np.clip(1 + 0.5 * cv2.resize(mottle, (pixels, pixels)), 0.2, 2)
    albedo = albedo * np.exp(-blush[..., None] * np.array([0.25, 1.0, 0.95], np.float32))
    albedo = albedo * (1 - look.shade * sulci[..., None] * np.array([0.35, 0.5, 0.42], np.float32))
    # Deep in a thick vessel no light comes back that could still be lost.
    arterial = arterial / (1 + arterial / 0.45)
    blood = look.arterial * arterial + look.capillary * thickness(tubes["capillaries"])
    fade = np.clip(0.75 + 0.35 * cv2.resize(wide, (pixels, pixels)), 0.25, 1.2)
    albedo = albedo * np.exp(-(blood * fade)[..., None] * _ARTERIAL)
    albedo = _veined(albedo, tubes["veins"], look, extent)
    # Light that enters tissue leaves it nearby, red farthest: a blur stands in for the volume.
    for channel, width in enumerate((0.055, 0.032, 0.024)):
        albedo[..., channel] = noise.blur(np.ascontiguousarray(albedo[..., channel]), width, extent)
    return np.asarray(np.clip(albedo, 0.01, 0.95), np.float32)


def _veined(albedo: Map, tube: tuple[Map, Map], look: Look, extent: float) -> Map:
    distance, radius = tube
    depth = np.clip(1 - (distance / np.maximum(radius, 1e-3)) ** 2, 0, 1)
    # Thin veins are wine red; the wall of a thick one scatters blue over dark blood.
    thick = np.clip((radius - 0.12) / 0.25, 0, 1)[..., None]
    colour = np.asarray(look.vein, np.float32) * thick + np.array([0.34, 0.10, 0.13], np.float32) * (
        1 - thick
    )
    wall = (1.15 - 0.4 * depth)[..., None] * colour
    cover = noise.blur(np.clip(depth * 2.5, 0, 1).astype(np.float32), 0.03, extent)[..., None]
    halo = noise.blur((depth > 0).astype(np.float32), 0.28, extent)[..., None]
    soft = albedo * np.exp(-0.9 * halo * np.array([0.35, 1.0, 0.75], np.float32))
    return np.asarray(soft * (1 - 0.95 * cover) + wall * 0.95 * cover, np.float32)


def _film(
    rng: np.random.Generator, look: Look, tubes: dict[str, tuple[Map, Map]], pixels: int, extent: float
) -> Map:
    """Height of the wet surface above the mesh: vessels under a film that evens out finer things."""
    relief = 0.42 * thickness(tubes["arteries"]) + 0.25 * thickness(tubes["capillaries"])
    relief = noise.blur(relief, look.film_mm, extent)
    coarse = 512
    pools = cv2.resize(noise.fractal(rng, coarse, extent, 5.0, 1.5), (pixels, pixels))
    # Mostly a smooth pool; where the film is thin the pia's own grain breaks the highlights up.
    dry = np.clip(0.6 * pools - 0.25, 0.05, 1.0)
    swell = noise.band(rng, coarse, extent, 2.4, 0.5) * 0.0065
    rough = noise.band(rng, coarse, extent, 0.55, 0.5) * 0.0060
    fine = noise.band(rng, pixels, extent, 0.22, 0.45) * 0.0016
    swell = cv2.resize(swell, (pixels, pixels), interpolation=cv2.INTER_CUBIC)
    rough = cv2.resize(rough, (pixels, pixels), interpolation=cv2.INTER_CUBIC) + fine
    return np.asarray(relief + look.bump * (swell + dry * rough), np.float32)


def _photograph(path: Path, pixels: int) -> Map:
    """The middle square of a photograph as linear albedo."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise UserError(f"appearance.photo: {path} is not a picture that can be read")
    side = min(image.shape[:2])
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    square = cv2.resize(
        image[top : top + side, left : left + side], (pixels, pixels), interpolation=cv2.INTER_AREA
    )
    encoded = square[..., ::-1].astype(np.float32) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    # First row of a map is the lower y.
    return np.asarray(np.clip(linear[::-1], 0.01, 0.95), np.float32)
