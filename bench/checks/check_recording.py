"""Check of a recording folder before it is scored."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from bench.checks.judgement import judge
from bench.recording import pixel_scale
from bench.recording.folder import Recording, open_recording
from bench.recording.tracking_picture import draw_tracking
from bench.tracking.tracking import TrackedRecording, track_recording
from synth.errors import UserError
from synth.recording_flow.decode import RecordingFlowSettings
from synth.recording_flow.finding import Finding, by_severity
from synth.recording_flow.frame_motion import FrameMotion
from synth.system.checked_file import write_picture

_TRIED = 12  # frames that are tracked to test whether tracking works


def check_recording(folder: Path, phantom: bool = False, picture: Path | None = None) -> list[Finding]:
    """Findings on a recording, errors first: its pictures are decoded and a few tracked. Raises no UserError.

    `phantom`: as in `open_recording`. `picture`: PNG of what is tracked, written if tracking works.
    """
    try:
        recording = open_recording(folder, phantom)
    except UserError as error:
        return [Finding("error", "recording", str(error))]
    mm_per_px, failed = 0.0, list[Finding]()
    with suppress(UserError):  # `check_scale` reports it
        mm_per_px = pixel_scale.find_scale(recording.meta, recording.folder).mm_per_px
    try:
        tracked = _track_some(recording, mm_per_px or 1.0, picture)
    except UserError as error:
        failed, tracked = [Finding("error", "tracking", str(error))], _decode(recording)
    tracked.scale_mm_per_px = mm_per_px
    return by_severity([*failed, *judge(recording, tracked)])


def _track_some(recording: Recording, mm_per_px: float, picture: Path | None) -> TrackedRecording:
    """Decodes every picture, and tracks a few as `bench score` does. UserError: as `track_recording`."""
    first = recording.meta.rest_frame
    numbers = [number for number in recording.numbers() or range(_TRIED) if number >= first] or [first]
    only = frozenset(numbers[k] for k in np.linspace(0, len(numbers) - 1, _TRIED).astype(int))
    settings, frames = RecordingFlowSettings(rate_hz=None, pulse=False), list[FrameMotion]()
    tracked = track_recording(recording, {}, mm_per_px, settings, only=only, each=frames.append)
    if picture is not None and tracked.tissue is not None:
        height, width = frames[0].rgb.shape[:2]
        tissue = cv2.resize(tracked.tissue.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        write_picture(picture, draw_tracking(frames, tissue > 0, tracked.size[1] // width))
    return tracked


def _decode(recording: Recording) -> TrackedRecording:
    """Numbers, times and size of the pictures up to the first unreadable one."""
    found = TrackedRecording()
    try:
        for picture in recording.frames():
            found.decoded.append((picture.index, picture.time_s))
            found.size = picture.rgb.shape[0], picture.rgb.shape[1]
    except UserError:
        pass  # tracking reports it
    return found
