"""A recording as the video that `synth.recording_flow` tracks, with its right or depth camera."""

from __future__ import annotations

import cv2
import numpy as np

from bench.recording.folder import Recording
from synth.arrays import Floats, Map
from synth.errors import UserError
from synth.flow.stereo import calibration
from synth.flow.stereo.rig import StereoRig
from synth.recording_flow.decode import Footage
from synth.recording_flow.finding import Finding
from synth.recording_flow.frame_motion import FrameMotion, Size
from synth.recording_flow.stereo import DepthVideo, RightVideo
from synth.system import checked_file

_REGION = Finding("missing", "tissue", "no tissue.png: the whole region is assumed to be tissue")
_LARGEST_BYTES = 1 << 30  # of an array of points


def as_footage(recording: Recording, mm_per_px: float) -> Footage:
    """The recording's video; `mm_per_px`: scale of its own pixels."""
    depth: RightVideo | DepthVideo | None = None
    if recording.right:
        depth = RightVideo(recording.right_frames, lambda size: _rig(recording, size), mm_per_px)
    elif recording.depths:
        depth = DepthVideo(
            lambda frame, size: _depth(recording, frame, size), lambda size: _K(recording, size), mm_per_px
        )
    return Footage(
        recording.frames,
        str(recording.folder),
        recording.tissue_mask if recording.tissue or recording.region else None,
        recording.masks.read if recording.masks else None,
        recording.meta.rest_frame,
        depth=depth,
        findings=() if recording.tissue or not recording.region else (_REGION,),
    )


def _rig(recording: Recording, size: Size) -> StereoRig:
    about = recording.meta.stereo
    assert about is not None
    return calibration.read_rig(recording.folder / about.calibration, size[::-1], about.mm_per_unit)


def _K(recording: Recording, size: Size) -> Floats:
    about, (height, width) = recording.meta.depth, size
    assert about is not None
    x, y = about.centre_px or ((width - 1) / 2, (height - 1) / 2)
    return np.array([[about.focal_px, 0, x], [0, about.focal_px, y], [0, 0, 1.0]])


def _depth(recording: Recording, frame: FrameMotion, size: Size) -> Map | None:
    """Depth (H, W) mm of a frame, or the third coordinate of its points; None: missing."""
    about = recording.meta.depth
    assert about is not None
    if frame.index not in recording.depths:
        if not frame.is_rest and frame.index < max(recording.depths):
            return None
        raise UserError(f"{recording.folder}: depth/ has no frame {frame.index}")
    path = recording.depths[frame.index]
    if path.suffix == ".npy":
        checked_file.check_file(path, _LARGEST_BYTES)
        try:
            found = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError):
            raise UserError(f"{path}: not a readable array") from None
    else:
        found = checked_file.read_picture(path, cv2.IMREAD_UNCHANGED)
    if found.ndim == 3 and found.shape[2] == 3 and found.dtype.kind == "f":
        found = found[..., 2]
    if found.ndim != 2 or found.shape != size or found.dtype.kind not in "uif":
        raise UserError(f"{path}: {found.shape} {found.dtype}, but the video is {size}")
    return np.asarray(found.astype(np.float32) * np.float32(about.mm_per_unit), np.float32)
