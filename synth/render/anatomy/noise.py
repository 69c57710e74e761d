"""Band-limited noise on square maps, and reading maps between their pixels.

A map covers the square [-extent/2, extent/2]^2 of the world's x, y: rows go with y, columns with x, and the
centre of the first pixel lies half a pixel inside the corner.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from synth.arrays import Floats, Indices, Map

_ROWS = 8  # of a map at a time: intermediate results stay in the processor's cache
_CHUNK = 8192  # pixels, for the same reason


def band(rng: np.random.Generator, pixels: int, extent_mm: float, wavelength_mm: float, width: float) -> Map:
    """Isotropic noise (pixels, pixels) float32 about one wavelength, in a band of half width `width` as a
    share of its centre frequency; zero mean, unit variance."""
    frequency = _frequencies(pixels, extent_mm)
    return _filter_noise(rng, np.exp(-0.5 * ((frequency * wavelength_mm - 1) / width) ** 2))


def fractal(rng: np.random.Generator, pixels: int, extent_mm: float, longest_mm: float, slope: float) -> Map:
    """Noise (n, n) of amplitude ~ 1/f^slope for waves below `longest_mm`; zero mean, unit variance."""
    frequency = _frequencies(pixels, extent_mm)
    return _filter_noise(rng, (frequency**2 + longest_mm**-2) ** (-0.5 * slope))


def blur(image: Map, sigma_mm: float, extent_mm: float) -> Map:
    """Gaussian blur of a map (n, n) or (n, n, c) by a width in mm."""
    sigma = sigma_mm * image.shape[0] / extent_mm
    # Wide kernels are slow; a small picture loses no detail of a widely blurred one.
    if sigma > 12:
        side = max(32, int(image.shape[0] * 6 / sigma))
        reduced = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
        reduced = cv2.GaussianBlur(
            reduced, (0, 0), sigma * side / image.shape[0], borderType=cv2.BORDER_REFLECT
        )
        return np.asarray(cv2.resize(reduced, image.shape[1::-1], interpolation=cv2.INTER_CUBIC), np.float32)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT), np.float32)


def map_rows(paint: Callable[..., tuple[Map, ...]], *maps: Map) -> tuple[Map, ...]:
    """Applies a pixelwise `paint` to maps (n, ...) a few rows at a time: faster, same bytes."""
    starts = range(0, len(maps[0]), _ROWS)
    parts = [paint(*(image[start : start + _ROWS] for image in maps)) for start in starts]
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def map_pixels(
    paint: Callable[..., tuple[Map, ...]], indices: Indices, fill: tuple[float, ...], *maps: Map
) -> tuple[Map, ...]:
    """As `map_rows`, of the pixels `indices` (M,) alone, counted row by row; others take `fill`."""
    flat = [image.reshape(-1, *image.shape[2:]) for image in maps]
    outputs = list[Map]()
    for start in range(0, len(indices), _CHUNK):
        chunk = indices[start : start + _CHUNK]
        for k, values in enumerate(paint(*(image[chunk][None] for image in flat))):
            if k == len(outputs):
                outputs.append(np.full((len(flat[0]), *values.shape[2:]), fill[k], np.float32))
            outputs[k][chunk] = values[0]
    return tuple(values.reshape(*maps[0].shape[:2], *values.shape[1:]) for values in outputs)


def sample(image: Map, xy: Floats, extent_mm: float) -> Map:
    """Map (n, n, ...) at world x, y (N, 2) mm, bilinear, constant beyond its border: (N, ...)."""
    pixel = ((xy / extent_mm + 0.5) * image.shape[0] - 0.5).astype(np.float32)
    width = 32_000  # cv2.remap takes pictures no longer than a short integer
    padding = -len(pixel) % width or width * (len(pixel) == 0)  # nor of no rows
    grid = np.pad(pixel, ((0, padding), (0, 0))).reshape(-1, width, 2)
    values = cv2.remap(image, grid, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, np.float32).reshape(-1, *image.shape[2:])[: len(pixel)]


def centres(pixels: int, extent_mm: float) -> Map:
    """World coordinate of the centres of a map's columns (or rows), (pixels,) mm."""
    return (((np.arange(pixels) + 0.5) / pixels - 0.5) * extent_mm).astype(np.float32)


def _frequencies(pixels: int, extent_mm: float) -> Floats:
    """Spatial frequency [1/mm] of each coefficient of a real transform."""
    step = extent_mm / pixels
    return np.asarray(np.hypot(np.fft.fftfreq(pixels, step)[:, None], np.fft.rfftfreq(pixels, step)[None]))


def _filter_noise(rng: np.random.Generator, gain: Floats) -> Map:
    pixels = len(gain)
    white_noise = rng.standard_normal((pixels, pixels), dtype=np.float32)
    spectrum = np.fft.rfft2(white_noise)
    gain[0, 0] = 0.0
    spectrum *= gain.astype(np.float32)
    filtered = np.fft.irfft2(spectrum, s=(pixels, pixels))
    return np.asarray((filtered - filtered.mean()) / filtered.std(), np.float32)
