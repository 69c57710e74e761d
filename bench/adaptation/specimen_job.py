"""A recording to a job: its own tissue's look, seen by a camera like its own, with what is known of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.adaptation import rest_texture
from bench.recording.folder import Recording
from bench.recording.pixel_scale import find_scale
from synth.errors import UserError
from synth.fit import fitting
from synth.fit.compression import Compression
from synth.fit.photograph import Photograph
from synth.fit.statistics import decode
from synth.flow import mask_detection
from synth.flow.stereo.calibration import read_rig
from synth.job.schema import Job
from synth.recording_flow.video_flow import LEAST_COLUMNS, shrink_mask, shrink_picture
from synth.render.anatomy.surface import MARGIN_MM
from synth.system.checked_file import write_picture

_FULL = 0.9  # of the picture is tissue: no opening's edge is in sight
_BEYOND_MM = 2.0  # that tissue then reaches past the picture's corners
_BASE_MM = 24.0  # of two eyes that aren't told, such as a depth camera's
_EVEN = 0.05  # by which scale and distance vary between sequences, relative
_EDGE_MM = 1.0  # of what hides tissue
_RECORDED = 0.74  # linear light in a frame of a default job over the reflectance, in the mean
_MEASURED = ("full_well", "read_noise", "vignette")
_MEMBRANE = {"stripped": 0.0, "unknown": 0.3, "intact": 1.0}
_FRAMES, _FPS = 8, 8.0  # of a sequence: as those that the networks have learnt from


@dataclass(frozen=True)
class RestView:
    """A recording's rest frame on the pixels that flow is computed on, and what of it is tissue."""

    rgb: NDArray[np.uint8]
    """(H, W, 3) sRGB."""
    tissue: NDArray[np.bool_]
    """(H, W)."""
    usable: NDArray[np.bool_]
    """(H, W) tissue that neither tool nor highlight hides."""
    mm_per_px: float


def rest_view(recording: Recording) -> RestView:
    """The rest frame. UserError: it is not there, or shows no tissue."""
    rest = next((one for one in recording.frames() if one.index >= recording.meta.rest_frame), None)
    if rest is None or rest.index != recording.meta.rest_frame:
        raise UserError(f"{recording.folder}: no frame {recording.meta.rest_frame}, the rest frame")
    size = (rest.rgb.shape[0], rest.rgb.shape[1])
    shrink = max(1, size[1] // LEAST_COLUMNS)
    scale = find_scale(recording.meta, recording.folder).mm_per_px * shrink
    rgb = shrink_picture(rest.rgb, shrink)
    tissue = shrink_mask(recording.tissue_mask(size), shrink, 127)
    tool = recording.masks.read(rest.index, size) if recording.masks else None
    hidden = mask_detection.blocked(rgb)
    if tool is not None:
        hidden |= shrink_mask(tool, shrink, 0)
    # Not their soft edges either, nor the shadow's.
    side = 2 * round(_EDGE_MM / scale) + 1
    usable = tissue & ~(cv2.dilate(hidden.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)
    if not usable.any():
        raise UserError(f"{recording.folder}: the rest frame shows no tissue")
    return RestView(rgb, tissue, usable, scale)


def specimen_job(recording: Recording, sequences: int, texture: Path) -> Job:
    """The job whose sequences look as the recording does. No sensor's value is read.

    Args:
        recording: what is to be adapted to.
        sequences: how many.
        texture: PNG to write: the rest frame's tissue without its light.

    Raises:
        UserError: no rest frame, too little tissue, or a stereo calibration that can't be read.
    """
    view = rest_view(recording)
    height, width = view.tissue.shape
    given = Photograph(view.rgb, view.usable, view.mm_per_px, Compression())
    sections = fitting.fit_camera(given)
    anatomy, region_mm = _opening(view)
    extent = 2 * (anatomy["craniotomy"]["radius_mm"] + MARGIN_MM)
    colour = np.minimum(decode(view.rgb)[view.usable].mean(axis=0) / _RECORDED, 1)
    picture = rest_texture.unroll(view.rgb, view.usable, view.mm_per_px, extent, colour)
    write_picture(texture, picture)
    render: dict[str, Any] = {
        "size": [width, height],
        "field_mm": [width * view.mm_per_px * factor for factor in (1 - _EVEN, 1 + _EVEN)],
    }
    render |= _two_eyes(recording, view.mm_per_px * width)
    # The picture's own sharpness and tone are in the texture.
    measured = {key: value for key, value in sections["sensor"].items() if key in _MEASURED}
    sensor = measured | {"sharpening": [0.0, 0.0], "contrast": [0.0, 0.0]}
    sensor |= _codec(recording, width * height)
    return Job.model_validate(
        {
            "seed": 0,
            "sequences": sequences,
            "frames": _FRAMES,
            "fps": _FPS,
            "anatomy": anatomy | {"vertices": 12_000},
            "appearance": {**sections["appearance"], "photo": texture, "cottonoid": 0.0},
            "fem": {
                "poisson": list(recording.meta.poisson),
                "skull": ["bonded", "slip"],
                "membrane": {"probability": _MEMBRANE[recording.meta.membrane]},
                "instruments": [1, 2],
                "contact_region_radius_mm": region_mm,
            },
            "sensor": sensor,
            "render": render,
        }
    )


def _opening(view: RestView) -> tuple[dict[str, Any], float]:
    """Where the skull is open, and how far from its middle what is loaded keeps [mm]."""
    height, width = (side * view.mm_per_px for side in view.tissue.shape)
    if view.tissue.mean() > _FULL:
        radius = math.hypot(height, width) / 2 + _BEYOND_MM
        return {"craniotomy": {"radius_mm": round(radius, 1)}}, round(0.4 * width, 1)
    radius = math.sqrt(float(view.tissue.sum()) * view.mm_per_px**2 / math.pi)
    return {"craniotomy": {"radius_mm": round(radius, 1)}}, round(radius, 1)


def _two_eyes(recording: Recording, width_mm: float) -> dict[str, Any]:
    """Baseline and working distance of a recording with a second eye; nothing of one without."""
    about = recording.meta.stereo
    if about is None:
        return {"stereo_mm": _BASE_MM} if recording.has_two_eyes else {}
    rest = next(iter(recording.right_frames()))
    size = rest.rgb.shape[1], rest.rgb.shape[0]
    rig = read_rig(recording.folder / about.calibration, size, about.mm_per_unit)
    away = float(rig.left.K[0, 0]) * width_mm / size[0]
    between = [away * factor for factor in (1 - _EVEN, 1 + _EVEN)]
    return {"stereo_mm": round(rig.baseline_mm, 3), "working_distance_mm": between}


def _codec(recording: Recording, pixels: int) -> dict[str, Any]:
    """The rate at which a video was packed, as bits a pixel; nothing of pictures."""
    film = recording.footage
    frames = len(recording.numbers())
    if not isinstance(film, Path) or not frames:
        return {}
    first = next(iter(recording.frames())).rgb
    bits = 8 * film.stat().st_size / frames / (first.shape[0] * first.shape[1])
    return {"bitrate_mbps": float(f"{bits * pixels * _FPS / 1e6:.3g}"), "chroma": "4:2:0"}
