"""Fit of the appearance family and of the camera parameters to a photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from synth.arrays import Floats, Map, Mask, Pixels
from synth.fit.photograph import Photograph, measure
from synth.job.schema import Family, Job
from synth.render.appearance.family import FAMILIES
from synth.render.camera import camera_sensor
from synth.render.camera.camera_sensor import CameraSensor, balanced_light, processed
from synth.render.camera.colour_processing import PLAIN, ColourProcessing
from synth.render.scene import SceneState
from synth.sequence.scene import at_rest

_LARGEST_MM, _SMALLEST_PX, _LARGEST_PX = 60.0, 160, 720
_PIXELS, _DIRECTIONS, _QUANTILES = 6000, 48, 100
_OFF_DIAGONAL = -0.6, 0.2  # range in published cameras
_KNOWN, _NEUTRAL = 0.1, 0.3  # weights of the priors for plain colours, and for equal curves of the channels
_INSET_PX, _CHOOSING_PX = 9, 320  # from the opening's edge; width of frames by which the family is chosen
_ANATOMIES = 2
_USUAL = CameraSensor()

_TRIED: dict[str, tuple[tuple[float, ...], Callable[[float], dict[str, float]]]] = {
    "vignette": ((0.0, 0.2, 0.4, 0.6, 0.8), lambda share: {"vignette": share}),
    "noise": (
        (0.3, 0.6, 1.0, 1.7, 3.0, 5.0, 8.0),
        lambda k: {"full_well": _USUAL.full_well / k**2, "read_noise": _USUAL.read_noise / k},
    ),
    "sharpness": (
        (4.0, 2.0, 1.0, 0.5, 0.0, -0.7, -1.5),
        lambda px: {"blur": max(px, 0.0), "sharpening": _USUAL.sharpening + max(-px, 0.0)},
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
        rng = np.random.default_rng(0)
        return balanced_light(self.radiance, replace(self.sensor, **keys), rng)[self.usable]


def fit_camera(given: Photograph) -> dict[str, Any]:
    """Sections of a job with the photograph's family and camera.

    Frames of that family are recorded with rising vignette, noise and blur, of which those are chosen that
    reproduce the photograph's statistics. Colours are fitted to the signal of that camera.
    """
    theirs, video = measure(given.rgb, given.usable), given.rgb[given.usable] / 255
    small = min(_CHOOSING_PX, given.rgb.shape[1] // 4 * 4)
    tissue = {name: render(name, small, given.mm_per_px, 0).light({}) for name in FAMILIES}
    family = min(FAMILIES, key=lambda name: fit_colours(tissue[name], video)[1])  # the closest
    widest = min(given.rgb.shape[1], _LARGEST_MM / given.mm_per_px)
    width = int(np.clip(widest, _SMALLEST_PX, _LARGEST_PX)) // 4 * 4
    frames = [render(family, width, given.mm_per_px, index) for index in range(_ANATOMIES)]
    reach = width / given.rgb.shape[1]
    keys: dict[str, Any] = {"vignette": _USUAL.vignette}

    def figure(name: str, tried: dict[str, float]) -> float:
        now = keys | tried
        now["vignette"] *= reach**2
        taken = ((given.compression.apply(one.record(now)), one.usable) for one in frames)
        return float(np.mean([measure(*one, reach)[name] for one in taken]))

    for name, (tried, as_keys) in _TRIED.items():
        measured = np.maximum.accumulate([figure(name, as_keys(value)) for value in tried])
        keys |= as_keys(float(np.interp(theirs[name], measured, tried)))
    here = keys | {"vignette": keys["vignette"] * reach**2}
    light = np.concatenate([one.light(here) for one in frames])
    keys |= fit_colours(light, video)[0]._asdict()
    rate = given.compression.bitrate_mbps(frames[0].record(keys))
    sensor = {name: np.round(value, 4).tolist() for name, value in keys.items()}
    sensor["blur_px"] = sensor.pop("blur")
    for name in ("full_well", "read_noise", "sharpening"):
        sensor[name] = [sensor[name]] * 2
    sensor |= {"chroma": given.compression.chroma, "bitrate_mbps": rate and round(rate, 2)}
    sections = {"appearance": {"families": [family]}, "sensor": sensor}
    Job.model_validate(sections)
    return sections


def render(family: Family, width: int, mm_per_px: float, index: int) -> TissueFrame:
    """A frame of a default job without instruments: the anatomy, view and light of sequence `index`."""
    field = width * mm_per_px
    anatomy = {"vertices": 8000, "craniotomy": {"radius_mm": 0.56 * field}}
    view = {"size": [width, width * 3 // 4], "field_mm": field, "tilt_deg": [0, 8]}
    drawn = {"appearance": {"families": [family]}, "fem": {"instrument": "none"}}
    job = Job.model_validate({"anatomy": anatomy, "render": view, **drawn})
    scene = at_rest(job, index)
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
    rng, plain = np.random.default_rng(0), np.array(PLAIN.curves)
    ours, theirs = rng.choice(light, _PIXELS)[None], rng.choice(video, _PIXELS)
    variances, axes = np.linalg.eigh(np.cov(theirs.T))
    directions = rng.standard_normal((3, _DIRECTIONS))
    directions /= np.linalg.norm(directions, axis=0)
    project = axes * (variances.max() / variances) ** 0.25 @ directions / np.sqrt(variances.sum())

    def quantiles(pixels: Floats) -> Floats:
        return np.asarray(np.sort(pixels @ project, axis=0).reshape(_QUANTILES, -1, _DIRECTIONS).mean(axis=1))

    wanted = quantiles(theirs)

    def residuals(free: Floats) -> Floats:
        colours = _colours(free)
        left = (quantiles(np.clip(processed(ours, *colours), 0, 1)[0]) - wanted) / np.sqrt(wanted.size)
        curves = np.array(colours.curves)
        unlike, odd = curves - curves.mean(axis=0), np.append(curves - plain, free[:6] - 1)
        return np.concatenate([left.ravel(), _NEUTRAL * unlike.ravel(), _KNOWN * odd])

    steps = np.log(np.diff(plain, axis=1, prepend=0))
    start = np.append(np.ones(6), steps[:, :4] - steps[:, 4:])
    ends = [np.repeat([1 + end, 8 * np.sign(end)], (6, 12)) for end in _OFF_DIAGONAL]
    found = least_squares(residuals, start, bounds=ends, max_nfev=40, diff_step=3e-3)
    return _colours(found.x), float(found.cost)


def _colours(free: Floats) -> ColourProcessing:
    """Colours from 6 off-diagonal elements plus 1, and 12 log steps of curves relative to the last."""
    matrix, off = np.eye(3), ~np.eye(3, dtype=bool)
    matrix[off] = free[:6] - 1
    matrix[~off] = 2 - matrix.sum(axis=1)
    steps = np.exp(np.pad(free[6:].reshape(3, 4), ((0, 0), (0, 1))))
    curves = np.cumsum(steps / steps.sum(axis=1, keepdims=True), axis=1)
    rows: list[Any] = [tuple(map(tuple, table.tolist())) for table in (matrix, curves)]
    return ColourProcessing(*rows)
