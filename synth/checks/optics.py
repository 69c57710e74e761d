"""Consistency of camera, depth, flow and load in every sequence: they are computed separately."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from synth.arrays import Floats
from synth.checks.measurements import Measure, Nothing, inner, truth
from synth.dataset.store import Sequence
from synth.errors import UserError
from synth.render.camera import camera as cameras
from synth.render.camera.camera_motion import CameraMotion
from synth.render.camera.camera_sensor import MOST_BLANK, blank_share


def picture(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """There is tissue in view; neither it nor the right picture is black or burnt out (share of pixels)."""
    tissue = sequence["tissue"][:]
    yield truth(bool(tissue.any()), "no tissue in view")
    for t in frames:
        regions = {"tissue": sequence["rgb"][t][tissue & ~sequence["tool"][t]]}
        if "rgb_right" in sequence:
            regions["right picture"] = sequence["rgb_right"][t]
        for region, pixels in regions.items():
            if len(pixels):
                blank = blank_share(pixels)
                yield Measure(blank, MOST_BLANK, f"frame {t}: {region} black or burnt out")


def camera(sequence: Sequence, frames: list[int]) -> Iterator[Measure | Nothing]:
    """The area per pixel and the scale agree with K, distortion and depth (relative)."""
    if "depth" not in sequence:
        yield Nothing("no depth is stored")
        return
    view, (height, width) = camera_of(sequence), sequence.size
    depth = sequence["depth"][0].astype(np.float64)
    tissue = sequence["tissue"][:] & ~sequence["tool"][0] & (depth > 0)
    core = inner(tissue, 4)
    if not core.any():
        yield Nothing("no tissue wider than 8 px in view")
        return
    points = cameras.rays(view, cameras.pixel_grid(view.size)).reshape(height, width, 3) * depth[..., None]
    across, down = 0.5 * (points[1:-1, 2:] - points[1:-1, :-2]), 0.5 * (points[2:, 1:-1] - points[:-2, 1:-1])
    spanned_area = np.linalg.norm(np.cross(across, down), axis=-1)
    interior = core[1:-1, 1:-1]
    area = np.maximum(sequence["area"][:][1:-1, 1:-1][interior], 1e-12)
    error = np.abs(spanned_area[interior] / area - 1)
    yield Measure(float(np.median(error)), 0.02, "area of the median pixel")
    yield Measure(float(np.quantile(error, 0.9)), 0.3, "area of 90% of the pixels")
    scale = float(np.median(depth[core])) / float(np.sqrt(view.K[0, 0] * view.K[1, 1]))
    yield Measure(abs(scale / view.mm_per_px - 1), 0.08, "scale")


def contact(sequence: Sequence, frames: list[int]) -> Iterator[Measure | Nothing]:
    """The centre of the load, moved by the flow, is at the projection of the instrument's tips [mm]."""
    instruments = (sequence.attrs.get("mechanics") or {}).get("instruments", [])
    if len(instruments) != 1:
        yield Nothing(f"{len(instruments) or 'no'} instruments")
        return
    if "force" not in sequence or not sequence.attrs["scenario"]["gestures"]:
        yield Nothing("another program's instrument")
        return
    rest_camera, tips = camera_of(sequence), np.asarray(instruments[0]["tip_mm"], np.float64)
    gesture = sequence.attrs["scenario"]["gestures"][0]
    # A reaction isn't even over the contact as a given pressure is: its centre is ahead of the middle.
    tolerance_mm = (0.25 if gesture.get("drive") else 0.1) * float(gesture["footprint_mm"])
    poses = camera_poses(sequence)
    area, inside = sequence["area"][:], inner(sequence["tissue"][:], 2)
    rows, columns = np.indices(sequence.size)
    peak = float(np.linalg.norm(sequence["force"][:], axis=1).max())
    for t in frames:
        size = np.linalg.norm(sequence["traction"][t], axis=-1)
        share = size * area
        # `not ... >` also skips the frame if the peak is NaN.
        if (size[~inside] > 0.02 * size.max()).any() or not share.sum() > 0.05 * peak:
            continue
        share = share / share.sum()
        flow = sequence["flow"][t]
        x, y = ((share * (base + flow[..., k])).sum() for k, base in enumerate((columns, rows)))
        view = replace(rest_camera, rotation=poses[t, :3, :3], translation=poses[t, :3, 3])
        tip = cameras.to_pixels(view, cameras.to_camera(view, tips[t].reshape(-1, 3))).mean(axis=0)
        error_mm = float(np.hypot(x - tip[0], y - tip[1])) * view.mm_per_px
        yield Measure(error_mm, tolerance_mm + view.mm_per_px, f"frame {t}", "mm")


def camera_poses(sequence: Sequence) -> Floats:
    """World to camera axes in every frame, (T, 4, 4) mm: as stored, else by the scenario's camera motion.
    Raises UserError if they are not stored and the motion is not one of ours."""
    if "camera" in sequence:
        return np.asarray(sequence["camera"][:])
    rest_camera, parameters = camera_of(sequence), (sequence.attrs.get("scenario") or {}).get("camera_motion")
    try:
        motion = CameraMotion(**parameters) if parameters else None
    except TypeError:
        raise UserError(f"{sequence.path}: its camera moves; store.extra=[camera] stores how") from None
    views = [motion.at(rest_camera, float(t)) if motion else rest_camera for t in sequence["time"][:]]
    return np.stack([view.pose for view in views])


def camera_of(sequence: Sequence, lens: Mapping[str, Any] | None = None) -> cameras.Camera:
    """The camera of a sequence, or that of another `lens` in its attributes, without aperture and focus."""
    lens, (height, width) = lens or sequence.attrs, sequence.size
    names = ("K", "distortion", "rotation", "translation")
    arrays = {name: np.asarray(lens[name], np.float64) for name in names}
    scale = float(sequence.attrs["scale_mm_per_px"])
    return cameras.Camera(**arrays, size=(width, height), aperture_mm=0.0, focus_mm=0.0, mm_per_px=scale)
