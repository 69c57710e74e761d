"""A recording as the video that `synth.flow.recording` tracks, with its right or depth camera."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from bench.recording.meta import Depth
from bench.recording.recording_folder import Recording
from bench.recording.tip_poses import read_tips
from synth.arrays import Floats, Map
from synth.errors import UserError, as_user_error
from synth.flow.recording.decode import Footage
from synth.flow.recording.finding import Finding
from synth.flow.recording.frame_motion import FrameMotion, Size
from synth.flow.recording.stereo_motion import DepthVideo, RightVideo
from synth.flow.stereo import calibration
from synth.system import checked_file

_REGION = Finding("missing", "tissue", "no tissue.png: the whole region is assumed to be tissue")
_LARGEST_BYTES = 1 << 30  # of an array of points


def as_footage(recording: Recording, mm_per_px: float) -> Footage:
    """The recording's video; `mm_per_px`: scale of its own pixels."""
    depth: RightVideo | DepthVideo | None = None
    if (pair := recording.meta.stereo) is not None:
        path, unit_mm = recording.folder / pair.calibration, pair.mm_per_unit
        depth = RightVideo(
            recording.right_frames, lambda size: calibration.read_rig(path, size[::-1], unit_mm), mm_per_px
        )
    elif (lens := recording.meta.depth) is not None:
        depth = DepthVideo(partial(_depth, recording, lens.mm_per_unit), partial(_K, lens), mm_per_px)
    tips = recording.meta.tips
    return Footage(
        recording.frames,
        str(recording.folder),
        recording.tissue_mask if recording.tissue or recording.region else None,
        recording.masks.read if recording.masks else None,
        recording.meta.rest_frame,
        depth=depth,
        findings=() if recording.tissue or not recording.region else (_REGION,),
        may_pulsate=recording.meta.may_pulsate,
        expected=None if tips is None else read_tips(recording.folder / "poses.csv", tips, mm_per_px).expect,
    )


def _K(lens: Depth, size: Size) -> Floats:
    x, y = lens.centre_px or ((size[1] - 1) / 2, (size[0] - 1) / 2)
    return np.array([[lens.focal_px, 0, x], [0, lens.focal_px, y], [0, 0, 1.0]])


def _depth(recording: Recording, unit_mm: float, frame: FrameMotion, size: Size) -> Map | None:
    """Depth (H, W) mm of a frame, or the third coordinate of its points; None: missing."""
    if frame.index not in recording.depths:
        if not frame.is_rest and frame.index < max(recording.depths):
            return None
        raise UserError(f"{recording.folder}: depth/ has no frame {frame.index}")
    path = recording.depths[frame.index]
    if path.suffix == ".npy":
        checked_file.check_file(path, _LARGEST_BYTES)
        with as_user_error(f"{path}: not a readable array"):
            values = np.load(path, allow_pickle=False)
    else:
        values = checked_file.read_picture(path, cv2.IMREAD_UNCHANGED)
    if values.shape[2:] == (3,) and values.dtype.kind == "f":
        values = values[..., 2]
    if values.shape != size or values.dtype.kind not in "uif":
        raise UserError(f"{path}: {values.shape} {values.dtype}, but the video is {size}")
    return np.asarray(values.astype(np.float32) * np.float32(unit_mm), np.float32)
