"""Fit of the appearance family and of the camera parameters to a photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, get_args

import cv2
import numpy as np
from scipy.optimize import least_squares

from synth.arrays import Floats, Map, Mask, Pixels
from synth.fit.photograph import Photograph, measure
from synth.job.schema import Family, Job, LightSection
from synth.render.camera import camera_sensor
from synth.render.camera.camera_sensor import CameraSensor, expose, process_colours
from synth.render.camera.colour_processing import PLAIN, ColourProcessing
from synth.render.scene import SceneState
from synth.sequence.rest_scene import at_rest

_LARGEST_MM, _LARGEST_PX, _CHOOSING_PX = 60.0, 720, 320  # of frames; and of those that choose the family
_PIXELS, _DIRECTIONS, _QUANTILES = 6000, 48, 100
_LOW, _HIGH = 0.4, 1.2  # 1 plus the off-diagonal elements of published cameras' matrices
_CURVE = 0.3  # largest change of a level of a tone curve
_KNOWN, _NEUTRAL = 0.1, 0.3  # weights of the priors for plain colours, and for equal curves of the channels
_INSET_PX, _ANATOMIES = 9, 3
_EVEN = float(np.mean(LightSection().even))  # radius of a usual lamp's spot, in widths of the field
_USUAL = CameraSensor()

_TRIED: dict[str, tuple[tuple[float, ...], Callable[[float], dict[str, float]]]] = {
    "vignette": ((0.0, 0.2, 0.4, 0.6, 0.8), lambda share: {"vignette": share}),
    "sharpness": (
        (4.0, 2.0, 1.0, 0.5, 0.0, -0.7, -1.5),
        lambda px: {"blur": max(px, 0.0), "sharpening": _USUAL.sharpening + max(-px, 0.0)},
    ),
    # After sharpness: fine texture that the lens blurs would be taken for noise.
    "noise": (
        (0.3, 0.6, 1.0, 1.7, 3.0, 5.0, 8.0),
        lambda k: {"full_well": _USUAL.full_well / k**2, "read_noise": _USUAL.read_noise / k},
    ),
}
"""By statistic: values to try, in the order in which it rises, and the sensor's keys for a value."""


class TissueFrame(NamedTuple):
    """A rendered frame before the camera's sensor."""

    radiance: Map  # (H, W, 3) linear
    usable: Mask  # (H, W) tissue
    sensor: CameraSensor  # default sensor with the sequence's exposure and white balance

    def record(self, keys: dict[str, Any]) -> Pixels:
        """The picture (H, W, 3) sRGB recorded by the sensor with these keys."""
        return camera_sensor.record(self.radiance, replace(self.sensor, **keys), np.random.default_rng(0))

    def light(self, keys: dict[str, Any]) -> Map:
        """The sensor's signal (N, 3) on tissue, white-balanced, 1 at full scale."""
        sensor = replace(self.sensor, **keys)
        return expose(self.radiance, sensor, np.random.default_rng(0))[self.usable]


def fit_camera(photograph: Photograph) -> dict[str, Any]:
    """Sections of a job with the photograph's family and camera.

    Frames of that family are recorded with rising vignette, blur and noise, of which those are chosen that
    reproduce the photograph's statistics. Colours are fitted to the signal of that camera.
    """
    target, video = measure(photograph.rgb, photograph.usable), photograph.rgb[photograph.usable] / 255
    widest = int(min(photograph.rgb.shape[1], _LARGEST_PX, _LARGEST_MM / photograph.mm_per_px)) // 4 * 4
    candidates = {
        name: render(name, min(_CHOOSING_PX, widest), photograph.mm_per_px, 0) for name in get_args(Family)
    }
    family = min(
        candidates, key=lambda name: fit_colours(candidates[name].light({}), video)[1]
    )  # the closest
    frames = [render(family, widest, photograph.mm_per_px, index) for index in range(_ANATOMIES)]
    reach = widest / photograph.rgb.shape[1]

    def scale_vignette(keys: dict[str, Any]) -> dict[str, Any]:
        return keys | {"vignette": keys["vignette"] * reach**2}  # frames show the photograph's middle

    def figure(name: str, keys: dict[str, Any]) -> float:
        recordings = (
            (photograph.compression.apply(frame.record(scale_vignette(keys))), frame.usable)
            for frame in frames
        )
        return float(np.mean([measure(*recording, reach)[name] for recording in recordings]))

    keys: dict[str, Any] = {"vignette": _USUAL.vignette}
    for name, (values, as_keys) in _TRIED.items():
        statistics = np.maximum.accumulate([figure(name, keys | as_keys(value)) for value in values])
        keys |= as_keys(float(np.interp(target[name], statistics, values)))
    light = np.concatenate([frame.light(scale_vignette(keys)) for frame in frames])
    keys |= fit_colours(light, video)[0]._asdict()
    sensor = {name: np.round(value, 4).tolist() for name, value in keys.items()}
    rate = photograph.compression.bitrate_mbps(frames[0].record(keys))
    sensor |= {"blur_px": sensor.pop("blur"), "chroma": photograph.compression.chroma, "bitrate_mbps": rate}
    return {"appearance": {"families": [family]}, "sensor": sensor}


def render(family: Family, width: int, mm_per_px: float, index: int) -> TissueFrame:
    """A frame of a default job without instruments or scenery: anatomy, view, light of sequence `index`."""
    field = width * mm_per_px
    anatomy = {"vertices": 8000, "craniotomy": {"radius_mm": 0.56 * field}}
    view = {"size": [width, width * 3 // 4], "field_mm": field, "tilt_deg": [0, 8], "scenery": []}
    # A picture doesn't tell a lamp's fall-off from the lens': that of a usual lamp is left to the lamp.
    light = {"even": [_EVEN, _EVEN]}
    sections = {"appearance": {"families": [family]}, "fem": {"instrument": "none"}, "light": light}
    scene = at_rest(Job.model_validate({"anatomy": anatomy, "render": view, **sections}), index)
    nowhere = np.zeros((2, 3))
    radiance = scene.renderer.render(SceneState(scene.surface.vertices, nowhere, nowhere), index).radiance
    usable = cv2.erode(scene.tissue.astype(np.uint8), np.ones((_INSET_PX, _INSET_PX), np.uint8)) > 0
    sensor = scene.scenario.appearance.sensor
    return TissueFrame(radiance, usable, replace(_USUAL, white=sensor.white, exposure=sensor.exposure))


def fit_colours(light: Map, video: Floats) -> tuple[ColourProcessing, float]:
    """The matrix, rows of sum 1, and rising curves with the least sliced Wasserstein distance, and the cost.

    Pixels are projected on random directions, sorted, and subtracted (J. Rabin et al., 2011); directions in
    which the photograph varies little have more weight, as lightness would dominate hue. `light`: (N, 3) as
    of `TissueFrame.light`; `video`: (M, 3) levels of the photograph's tissue, 0 to 1.
    """
    rng, plain_levels = np.random.default_rng(0), np.array(PLAIN.curves)[:, :4].ravel()
    rendered, photographed = rng.choice(light, _PIXELS)[None], rng.choice(video, _PIXELS)
    variances, axes = np.linalg.eigh(np.cov(photographed.T))
    directions = rng.standard_normal((3, _DIRECTIONS))
    directions /= np.linalg.norm(directions, axis=0)
    project = axes * (variances.max() / variances) ** 0.25 @ directions / np.sqrt(variances.sum())

    def quantiles(pixels: Floats) -> Floats:
        return np.asarray(np.sort(pixels @ project, axis=0).reshape(_QUANTILES, -1, _DIRECTIONS).mean(axis=1))

    target = quantiles(photographed)

    def residuals(parameters: Floats) -> Floats:
        colours = _colours(parameters)
        mismatch = (quantiles(np.clip(process_colours(rendered, *colours), 0, 1)[0]) - target) / np.sqrt(
            target.size
        )
        channel_spread = np.array(colours.curves) - np.mean(colours.curves, axis=0)
        return np.concatenate(
            [mismatch.ravel(), _NEUTRAL * channel_spread.ravel(), _KNOWN * (parameters - start)]
        )

    start = np.append(np.ones(6), plain_levels)
    low, high = np.append([_LOW] * 6, plain_levels - _CURVE), np.append([_HIGH] * 6, plain_levels + _CURVE)
    solution = least_squares(residuals, start, bounds=(low, high), max_nfev=40, diff_step=3e-3)
    return _colours(solution.x), float(solution.cost)


def _colours(parameters: Floats) -> ColourProcessing:
    """Colours from 6 off-diagonal elements plus 1, and the first 4 levels of 3 curves, made to rise to 1."""
    a, b, c, d, e, f = parameters[:6] - 1
    matrix = np.array([[1 - a - b, a, b], [c, 1 - c - d, d], [e, f, 1 - e - f]])
    levels = np.pad(np.clip(parameters[6:].reshape(3, 4), 0, 1), ((0, 0), (0, 1)), constant_values=1)
    rows: list[Any] = [
        tuple(map(tuple, table.tolist())) for table in (matrix, np.maximum.accumulate(levels, 1))
    ]
    return ColourProcessing(*rows)
