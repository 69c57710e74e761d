"""A photograph in, a look out: the nearest family, and the camera that the photograph was taken with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from synth.fit.photograph import Photograph
from synth.fit.statistics import Map, Mask, Picture, measure
from synth.job.schema import Family, Job
from synth.render.appearance.family import FAMILIES
from synth.render.camera import camera_sensor
from synth.render.camera.camera_sensor import CameraSensor
from synth.render.scene import SceneState
from synth.sequence.scene import at_rest

_LARGEST_MM, _SMALLEST_PX, _LARGEST_PX = 60.0, 160, 720
_INSET_PX = 9  # from the opening's edge
_ANATOMIES = 2
# Green and blue over red in frames, against those of the reflectances they were rendered with.
_GREEN, _BLUE = 0.825, 0.735
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
"""Of each figure: values that are tried, in the order in which it rises, and the sensor's keys for them."""


@dataclass(frozen=True)
class TissueFrame:
    """A rendered frame before its sensor."""

    radiance: Map
    """(H, W, 3) linear."""
    usable: Mask
    """(H, W) tissue."""
    sensor: CameraSensor
    """Of its sequence."""

    def record(self, keys: Mapping[str, Any]) -> Picture:
        """The picture (H, W, 3) sRGB of the usual sensor with these keys, white-balanced as its own is."""
        usual = replace(_USUAL, white=self.sensor.white, exposure=self.sensor.exposure)
        return camera_sensor.record(self.radiance, replace(usual, **keys), np.random.default_rng(0))


def fit_camera(given: Photograph) -> dict[str, Any]:
    """Sections of a job with the photograph's family and camera.

    Frames of a default job of that family are rendered as wide as the photograph, then recorded and packed
    with rising vignette, noise and blur: those are taken with which they measure what the photograph does.
    """
    theirs = measure(given.rgb, given.usable, given.mm_per_px)
    family = nearest_family(theirs)
    widest = min(given.rgb.shape[1], _LARGEST_MM / given.mm_per_px)
    width = int(np.clip(widest, _SMALLEST_PX, _LARGEST_PX)) // 4 * 4
    frames = [render(family, width, given.mm_per_px, index) for index in range(_ANATOMIES)]
    reach = width / given.rgb.shape[1]
    keys: dict[str, float] = {}

    def figure(name: str, tried: dict[str, float]) -> float:
        camera_now = keys | tried
        camera_now["vignette"] = camera_now.get("vignette", _USUAL.vignette) * reach**2
        taken = [given.compression.apply(one.record(camera_now)) for one in frames]
        scale = given.mm_per_px, reach
        figures = [measure(rgb, one.usable, *scale) for rgb, one in zip(taken, frames, strict=True)]
        return float(np.mean([one[name] for one in figures]))

    for name, (tried, as_keys) in _TRIED.items():
        if np.isfinite(theirs[name]):
            measured = np.maximum.accumulate([figure(name, as_keys(value)) for value in tried])
            keys |= as_keys(float(np.interp(theirs[name], measured, tried)))
    rate = given.compression.bitrate_mbps(frames[0].record(keys))
    sensor: dict[str, Any] = {
        {"blur": "blur_px"}.get(name, name): float(f"{value:.3g}") for name, value in keys.items()
    }
    for name in {"full_well", "read_noise", "sharpening"} & set(sensor):
        sensor[name] = [sensor[name]] * 2
    sensor |= {"chroma": given.compression.chroma} | ({} if rate is None else {"bitrate_mbps": rate})
    sections = {"appearance": {"families": [family]}, "sensor": sensor}
    Job.model_validate(sections)
    return sections


def nearest_family(theirs: dict[str, float]) -> Family:
    """The family whose tissue has most nearly the photograph's ratios of colours."""

    def off(family: Family) -> float:
        r, g, b = np.add(FAMILIES[family].crown, FAMILIES[family].flush)
        green, blue = _GREEN * g / r / theirs["green"], _BLUE * b / r / theirs["blue"]
        return float(np.hypot(np.log(green), np.log(blue)))

    return min(FAMILIES, key=off)


def render(family: Family, width: int, mm_per_px: float, index: int) -> TissueFrame:
    """A default frame without instruments: the anatomy, view and light of sequence `index`."""
    field = width * mm_per_px
    job = Job.model_validate(
        {
            "anatomy": {"vertices": 8000, "craniotomy": {"radius_mm": 0.56 * field}},
            "appearance": {"families": [family]},
            "render": {"size": [width, width * 3 // 4], "field_mm": field, "tilt_deg": [0, 8], "tool": False},
        }
    )
    scene = at_rest(job, index)
    nowhere = np.zeros((2, 3))
    state = SceneState(scene.surface.vertices, nowhere, nowhere)
    radiance = scene.renderer.render(state, seed=index).radiance
    usable = cv2.erode(scene.tissue.astype(np.uint8), np.ones((_INSET_PX, _INSET_PX), np.uint8)) > 0
    return TissueFrame(radiance, usable, scene.scenario.look.sensor)
