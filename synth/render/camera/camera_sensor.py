"""From radiance to the recorded picture: one pure function, in the order light goes through a camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

from synth.render.camera.colour_processing import KNOTS, PLAIN, Curve, Curves, Matrix, encoded
from synth.system.jit import vectorised

Map = npt.NDArray[np.float32]

_HEADROOM = KNOTS[-1]  # times full scale that the sensor still measures
_STEPS = 4096  # of the tone curves, over full scale


@dataclass(frozen=True)
class CameraSensor:
    """A colour camera on the microscope."""

    exposure: float = 1.0
    """Share of full scale that radiance 1 fills."""
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """White balance: gain of red, green, blue. A channel of less than 1 still reaches full scale."""
    full_well: float = 12_000.0
    """Photoelectrons at full scale."""
    read_noise: float = 12.0
    """Standard deviation of the readout [electrons]."""
    bits: int = 12
    """Of the converter."""
    vignette: float = 0.15
    """Share of light lost in the picture's corners."""
    blur: float = 0.0
    """Standard deviation of the optics' blur [px]."""
    bloom: float = 0.03
    """Share of light that the optics scatter around."""
    matrix: Matrix = PLAIN.matrix
    """From balanced sensor colours to the picture's, in linear light; rows that sum to 1 keep white."""
    curves: Curves = PLAIN.curves
    """Tone curves of red, green, blue: video levels (1: white, more is cut off) at `KNOTS` of full scale."""
    sharpening: float = 0.3
    """Unsharp mask of the video processor, as a share of the detail."""
    chroma: str = "4:4:4"
    """Colour resolution of the video: 4:4:4, 4:2:2 or 4:2:0."""
    coded: bool = False
    """Whether a codec follows, which thins the colours out itself."""


def record(radiance: Map, sensor: CameraSensor, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """The 8-bit sRGB picture of a linear one.

    Args:
        radiance: (H, W, 3) float32, linear.
        sensor: the camera.
        rng: photon and readout noise.

    Returns:
        (H, W, 3) uint8.
    """
    video = processed(balanced_light(radiance, sensor, rng), sensor.matrix, sensor.curves)
    video = _sharpen(video, sensor.sharpening)
    np.clip(video, 0, 1, out=video)
    video = video if sensor.coded else _thinned(video, sensor.chroma)
    np.clip(video, 0, 1, out=video)
    video *= np.float32(255)
    return np.rint(video, out=video).astype(np.uint8)


def balanced_light(radiance: Map, sensor: CameraSensor, rng: np.random.Generator) -> Map:
    """What the chip measures of radiance (H, W, 3), white-balanced, 1 at full scale, up to `_HEADROOM`."""
    white = np.asarray(sensor.white, np.float32)
    # Gains below 1 are taken off the exposure: what fills the sensor has to be white, not short of a colour.
    least = white.min()
    light = radiance * (least * sensor.exposure * _falloff(radiance.shape[:2], sensor.vignette))[..., None]
    if sensor.blur > 0:
        light = cv2.GaussianBlur(light, (0, 0), sensor.blur)
    light = _scatter(light, sensor.bloom)
    balanced = rng.standard_normal(light.shape, dtype=np.float32)
    well, read = np.float32(sensor.full_well), np.float32(sensor.read_noise**2)
    most = np.float32(_HEADROOM)
    steps = np.float32(2**sensor.bits - 1) / most
    _convert(np.asarray(light, np.float32), well, read, steps, most, white / least, balanced)
    return balanced


def processed(linear: Map, matrix: Matrix, curves: Curves) -> Map:
    """Video levels of balanced light (H, W, 3), `_HEADROOM` at most: a matrix, then a curve a channel.

    Between knots a curve is monotone (F. N. Fritsch, R. E. Carlson, 1980) over sRGB-encoded light, of which
    it makes plain sRGB where its levels are `encoded(KNOTS)`. Black is 0.
    """
    video = np.empty(linear.shape, np.float32)
    red, green, blue = (_table(curve) for curve in curves)
    light, mixed = np.ascontiguousarray(linear, np.float32), np.array(matrix, np.float32)
    _look_up(light, mixed, red, green, blue, video)
    return video


@lru_cache(16)
def _table(curve: Curve) -> Map:
    """A tone curve in `_STEPS` a full scale."""
    levels = encoded(np.linspace(0, _HEADROOM, int(_HEADROOM * _STEPS) + 1))
    curve_of = PchipInterpolator(encoded(np.array([0.0, *KNOTS])), [0.0, *curve])
    return np.asarray(curve_of(levels), np.float32)


@vectorised
def _convert(
    light: Map,
    well: np.float32,
    read: np.float32,
    steps: np.float32,
    most: np.float32,
    white: Map,
    noise: Map,
) -> None:
    """Noise, converter of so many `steps` and white balance, up to `most` times full scale.

    Takes normal `noise` (H, W, 3) and leaves the picture in it.
    """
    zero = np.float32(0)
    for y in range(light.shape[0]):
        for x in range(light.shape[1]):
            for k in range(3):
                electrons = max(light[y, x, k], zero) * well
                # A Poisson count this large is a Gaussian to within the readout noise.
                electrons = electrons + noise[y, x, k] * np.sqrt(electrons + read)
                digital = np.rint(min(max(electrons / well, zero), most) * steps) / steps
                noise[y, x, k] = min(max(digital * white[k], zero), most)


def _thinned(video: Map, chroma: str) -> Map:
    """Colour at half the resolution across, or across and down."""
    if chroma == "4:4:4":
        return video
    height, width = video.shape[:2]
    small = ((width + 1) // 2, height if chroma == "4:2:2" else (height + 1) // 2)
    parts = cv2.cvtColor(np.ascontiguousarray(video, np.float32), cv2.COLOR_RGB2YCrCb)
    for channel in (1, 2):
        coarse = cv2.resize(parts[..., channel], small, interpolation=cv2.INTER_AREA)
        parts[..., channel] = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(parts, cv2.COLOR_YCrCb2RGB), np.float32)


def _falloff(shape: tuple[int, int], vignette: float) -> Map:
    rows = (np.arange(shape[0], dtype=np.float32) - (shape[0] - 1) / 2)[:, None]
    columns = (np.arange(shape[1], dtype=np.float32) - (shape[1] - 1) / 2)[None]
    r2 = (rows**2 + columns**2) / ((shape[0] - 1) ** 2 + (shape[1] - 1) ** 2) * 4
    return (1 - vignette * r2).astype(np.float32)


def _scatter(light: Map, share: float) -> Map:
    """A narrow halo around bright spots; the light it takes is taken from them."""
    if share == 0:
        return light
    sigma = light.shape[1] / 200
    small = cv2.resize(light, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    halo = cv2.resize(cv2.GaussianBlur(small, (0, 0), max(sigma / 2, 0.5)), light.shape[1::-1])
    return np.asarray((1 - share) * light + share * halo, np.float32)


@vectorised
def _look_up(linear: Map, matrix: Map, red: Map, green: Map, blue: Map, video: Map) -> None:
    """A matrix (3, 3) on linear (H, W, 3), and of it curves of `_STEPS` a full scale, into `video`."""
    most, steps = np.float32(len(red) - 1.001), np.float32(_STEPS)
    for y in range(linear.shape[0]):
        for x in range(linear.shape[1]):
            r, g, b = linear[y, x, 0] * steps, linear[y, x, 1] * steps, linear[y, x, 2] * steps
            for k, curve in enumerate((red, green, blue)):
                at = matrix[k, 0] * r + matrix[k, 1] * g + matrix[k, 2] * b
                at = min(max(at, np.float32(0)), most)
                low = np.int32(at)
                video[y, x, k] = curve[low] + (at - np.float32(low)) * (curve[low + 1] - curve[low])


def _sharpen(video: Map, amount: float) -> Map:
    if amount == 0:
        return video
    sharp = cv2.GaussianBlur(video, (0, 0), 1.0)
    np.subtract(video, sharp, out=sharp)
    sharp *= np.float32(amount)
    return np.asarray(np.add(video, sharp, out=sharp), np.float32)
