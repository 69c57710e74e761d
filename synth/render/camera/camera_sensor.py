"""From radiance to the recorded picture: one pure function, in the order of a camera's signal chain."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.interpolate import PchipInterpolator

from synth.arrays import Map, Pixels
from synth.render.camera.colour_processing import KNOTS, PLAIN, Curve, Curves, Matrix, encode_srgb
from synth.system.jit import argument_types, vectorised

_HEADROOM = KNOTS[-1]  # saturation of the sensor, in full scales
_STEPS = 4096  # of the tabulated tone curves per full scale

MOST_BLANK = 0.95
"""Largest share of the tissue's pixels that may be black or burnt out."""
_BLACK, _WHITE = 6, 250


def blank_share(rgb: Pixels) -> float:
    """Share of colours (..., 3) that are black or burnt out."""
    return float(((rgb.max(axis=-1) <= _BLACK) | (rgb.min(axis=-1) >= _WHITE)).mean())


@dataclass(frozen=True)
class CameraSensor:
    """A colour camera on the microscope."""

    exposure: float = 1.0  # share of full scale that radiance 1 fills
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)  # white balance: gain of red, green, blue
    full_well: float = 12_000.0  # photoelectrons at full scale
    read_noise: float = 12.0  # standard deviation of the readout [electrons]
    bits: int = 12  # of the converter
    vignette: float = 0.15  # share of light lost in the picture's corners
    blur: float = 0.0  # standard deviation of the optics' blur [px]
    bloom: float = 0.03  # share of light that the optics scatter around
    matrix: Matrix = PLAIN.matrix  # from balanced sensor colours to the picture's; rows of sum 1 keep white
    curves: Curves = PLAIN.curves  # tone curves of red, green, blue: video levels at `KNOTS` of full scale
    sharpening: float = 0.3  # unsharp mask of the video processor, as a share of the detail
    chroma: str = "4:4:4"  # colour resolution of the video: 4:4:4, 4:2:2 or 4:2:0
    native: float = 1.0  # its pixels across, as a share of the picture's, which is scaled up
    halo_px: float = 1.0  # width of the unsharp mask: standard deviation [px of the sensor]
    coded: bool = False  # whether a codec follows, which subsamples colours itself


def record(radiance: Map, sensor: CameraSensor, rng: np.random.Generator) -> Pixels:
    """The sRGB picture (H, W, 3) uint8 of linear radiance (H, W, 3) float32; `rng`: of the noise."""
    size = radiance.shape[1::-1]
    if sensor.native < 1:
        sensor_size = [max(round(sensor.native * side), 8) for side in size]
        radiance = cv2.resize(radiance, sensor_size, interpolation=cv2.INTER_AREA)
    video = process_colours(expose(radiance, sensor, rng), sensor.matrix, sensor.curves)
    video = _sharpen(video, sensor.sharpening, sensor.halo_px)
    if sensor.native < 1:
        video = cv2.resize(video, size, interpolation=cv2.INTER_CUBIC)
    np.clip(video, 0, 1, out=video)
    video = video if sensor.coded else _subsample_chroma(video, sensor.chroma)
    return np.asarray(np.rint(np.clip(video, 0, 1) * np.float32(255)), np.uint8)


def expose(radiance: Map, sensor: CameraSensor, rng: np.random.Generator) -> Map:
    """White-balanced signal of the chip for radiance (H, W, 3): 1 at full scale, up to `_HEADROOM`."""
    white = np.asarray(sensor.white, np.float32)
    # Gains below 1 lower the exposure instead, so that what saturates the sensor is white.
    least = white.min()
    light = radiance * (least * sensor.exposure * _falloff(radiance.shape[:2], sensor.vignette))[..., None]
    if sensor.blur > 0:
        light = cv2.GaussianBlur(light, (0, 0), sensor.blur)
    light = _scatter(light, sensor.bloom)
    signal = rng.standard_normal(light.shape, dtype=np.float32)
    well, read_variance = np.float32(sensor.full_well), np.float32(sensor.read_noise**2)
    steps = np.float32(2**sensor.bits - 1) / np.float32(_HEADROOM)
    _convert(np.asarray(light, np.float32), well, read_variance, steps, white / least, signal)
    return signal


def process_colours(linear: Map, matrix: Matrix, curves: Curves) -> Map:
    """Video levels of balanced light (H, W, 3), `_HEADROOM` at most: a matrix, then a curve per channel.

    Between knots a curve is monotone (F. N. Fritsch, R. E. Carlson, 1980) over sRGB-encoded light; levels of
    `encode_srgb(KNOTS)` give plain sRGB. Black is 0.
    """
    video = np.empty(linear.shape, np.float32)
    light = np.ascontiguousarray(linear, np.float32)
    red, green, blue = (_table(curve) for curve in curves)
    _look_up(light, np.array(matrix, np.float32), red, green, blue, video)
    return video


@lru_cache(16)
def _table(curve: Curve) -> Map:
    """A tone curve, tabulated in `_STEPS` per full scale."""
    levels = encode_srgb(np.linspace(0, _HEADROOM, int(_HEADROOM * _STEPS) + 1))
    spline = PchipInterpolator(encode_srgb(np.array([0.0, *KNOTS])), [0.0, *curve])
    return np.asarray(spline(levels), np.float32)


@argument_types("f4[:,:,::1], f4, f4, f4, f4[::1], f4[:,:,::1]")
@vectorised
def _convert(
    light: Map, well: np.float32, read_variance: np.float32, steps: np.float32, white: Map, noise: Map
) -> None:
    """Noise, converter with `steps` per full scale, and white balance, up to `_HEADROOM`.

    Normal `noise` (H, W, 3) is overwritten by the result.
    """
    zero, full_scale = np.float32(0), np.float32(_HEADROOM)
    for y in range(light.shape[0]):
        for x in range(light.shape[1]):
            for k in range(3):
                electrons = max(light[y, x, k], zero) * well
                # A Poisson count this large is a Gaussian to within the readout noise.
                electrons = electrons + noise[y, x, k] * np.sqrt(electrons + read_variance)
                digital = np.rint(min(max(electrons / well, zero), full_scale) * steps) / steps
                noise[y, x, k] = min(max(digital * white[k], zero), full_scale)


def _subsample_chroma(video: Map, chroma: str) -> Map:
    """Video with its colour at half the resolution across, or across and down."""
    if chroma == "4:4:4":
        return video
    height, width = video.shape[:2]
    chroma_size = ((width + 1) // 2, height if chroma == "4:2:2" else (height + 1) // 2)
    planes = cv2.cvtColor(np.ascontiguousarray(video, np.float32), cv2.COLOR_RGB2YCrCb)
    for channel in (1, 2):
        coarse = cv2.resize(planes[..., channel], chroma_size, interpolation=cv2.INTER_AREA)
        planes[..., channel] = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(planes, cv2.COLOR_YCrCb2RGB), np.float32)


def _falloff(shape: tuple[int, int], vignette: float) -> Map:
    rows = (np.arange(shape[0], dtype=np.float32) - (shape[0] - 1) / 2)[:, None]
    columns = (np.arange(shape[1], dtype=np.float32) - (shape[1] - 1) / 2)[None]
    r2 = (rows**2 + columns**2) / ((shape[0] - 1) ** 2 + (shape[1] - 1) ** 2) * 4
    return (1 - vignette * r2).astype(np.float32)


def _scatter(light: Map, share: float) -> Map:
    """Light with a narrow halo around bright spots, at the spots' expense."""
    sigma = light.shape[1] / 200
    half_size = cv2.resize(light, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    halo = cv2.resize(cv2.GaussianBlur(half_size, (0, 0), max(sigma / 2, 0.5)), light.shape[1::-1])
    return np.asarray((1 - share) * light + share * halo, np.float32)


@argument_types("f4[:,:,::1], f4[:,::1], f4[::1], f4[::1], f4[::1], f4[:,:,::1]")
@vectorised
def _look_up(linear: Map, matrix: Map, red: Map, green: Map, blue: Map, video: Map) -> None:
    """Writes to `video` a matrix (3, 3) on linear (H, W, 3), then tabulated curves."""
    last, steps = np.float32(len(red) - 1.001), np.float32(_STEPS)
    for y in range(linear.shape[0]):
        for x in range(linear.shape[1]):
            r, g, b = linear[y, x, 0] * steps, linear[y, x, 1] * steps, linear[y, x, 2] * steps
            for k, curve in enumerate((red, green, blue)):
                level = matrix[k, 0] * r + matrix[k, 1] * g + matrix[k, 2] * b
                level = min(level, last) if level > 0 else np.float32(0)  # also where it is no number
                index = np.int32(level)
                video[y, x, k] = curve[index] + (level - np.float32(index)) * (
                    curve[index + 1] - curve[index]
                )


def _sharpen(video: Map, amount: float, sigma: float) -> Map:
    if amount == 0:
        return video
    detail = cv2.GaussianBlur(video, (0, 0), sigma)
    np.subtract(video, detail, out=detail)
    detail *= np.float32(amount)
    return np.asarray(np.add(video, detail, out=detail), np.float32)
