"""Check of a recording folder before it is scored."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from bench.checks.judgement import judge
from bench.checks.protocol import check_protocol
from bench.recording.recording_folder import Recording, open_recording
from bench.tracking.tracking import TrackedRecording, track_recording
from synth.arrays import Mask
from synth.errors import UserError
from synth.flow.confidence import LOW_CONFIDENCE
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.finding import Finding, by_severity
from synth.flow.recording.frame_motion import FrameMotion
from synth.publish.picture import Rgb, arrow_gain, arrows, enlarge, frame_panel, overlay, tile
from synth.system.checked_file import write_picture

_TRIED = 12  # frames that are tracked to test whether tracking works
_SHOWN = 5
_TISSUE, _MASKED = (60, 230, 90), (230, 40, 220)
_LEGEND = "green: tissue; magenta: masked; arrows: trusted motion"


def check_recording(folder: Path, phantom: bool = False, picture: Path | None = None) -> list[Finding]:
    """Findings on a recording, errors first, from all pictures and a few tracked ones. No UserError.

    `phantom`: as in `open_recording`. `picture`: PNG of what is tracked, written if tracking works.
    """
    try:
        recording = open_recording(folder, phantom)
    except UserError as error:
        return [Finding("error", "recording", str(error))]
    mm_per_px, failures = 0.0, list[Finding]()
    with suppress(UserError):  # `check_scale` reports it
        mm_per_px = recording.scale.mm_per_px
    try:
        tracked = _track_some(recording, mm_per_px or 1.0, picture)
    except UserError as error:
        failures, tracked = [Finding("error", "tracking", str(error))], _decode(recording)
    tracked.scale_mm_per_px = mm_per_px
    return by_severity([*failures, *judge(recording, tracked), *check_protocol(recording)])


def _track_some(recording: Recording, mm_per_px: float, picture: Path | None) -> TrackedRecording:
    """Decodes every picture, and tracks a few as `bench score` does. UserError: as `track_recording`."""
    first = recording.meta.rest_frame
    numbers = [number for number in recording.numbers or range(_TRIED) if number >= first] or [first]
    subset = frozenset(numbers[k] for k in np.linspace(0, len(numbers) - 1, _TRIED).astype(int))
    settings, frames = RecordingFlowSettings(rate_hz=None, pulse=False), list[FrameMotion]()
    tracked = track_recording(recording, {}, mm_per_px, settings, only=subset, on_frame=frames.append)
    if picture is not None and tracked.tissue is not None:
        height, width = frames[0].rgb.shape[:2]
        tissue = cv2.resize(tracked.tissue.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        write_picture(picture, _draw_tracking(frames, tissue > 0, tracked.size[1] // width))
    return tracked


def _draw_tracking(frames: Sequence[FrameMotion], tissue: Mask, shrink: int) -> Rgb:
    """The rest frame, which is the first, the frame with the largest motion and three others: (H, W, 3).

    `tissue`: (h, w); `shrink`: factor by which frames are smaller than the video; lengths are in its pixels.
    """
    trusted = [tissue & (frame.confidence > LOW_CONFIDENCE) for frame in frames]
    lengths = [
        np.linalg.norm(frame.flow, axis=-1) * mask for frame, mask in zip(frames, trusted, strict=True)
    ]
    peaks_px = [float(np.percentile(length[tissue], 99)) for length in lengths]
    strongest = int(np.argmax(peaks_px))
    others = [k for k in range(1, len(frames)) if k != strongest]
    extras = [others[k] for k in np.linspace(0, len(others) - 1, min(_SHOWN - 2, len(others))).astype(int)]
    gain, panels = arrow_gain(2 * tissue.shape[1], max(peaks_px)), []
    for k in sorted({0, strongest, *extras}):
        frame, picture = frames[k], enlarge(frames[k].rgb)
        zoom = picture.shape[1] // tissue.shape[1]
        outline, moving, masked = (
            enlarge(np.asarray(mask, np.uint8)[..., None])[..., 0] > 0
            for mask in (tissue, trusted[k], frame.hidden)
        )
        picture = overlay(picture, np.full_like(picture, 255), 0.3 * outline)
        picture = overlay(picture, np.full_like(picture, _MASKED), 0.5 * masked)
        edges = cv2.findContours(outline.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(picture, edges, -1, _TISSUE, 2)
        flow = zoom * frame.flow.repeat(zoom, axis=0).repeat(zoom, axis=1)
        picture = arrows(picture, flow, moving, gain)
        time = "" if frame.time_s is None else f", {frame.time_s:.2f} s"
        caption = f"{peaks_px[k] * shrink:.1f} px at most, arrows x{gain}" if k else "rest frame"
        caption = caption if frame.trusted else "tracking lost"
        panels.append(frame_panel(picture, f"frame {frame.index}{time}: {caption}"))
    return tile([*panels, frame_panel(np.full_like(picture, 255), _LEGEND)])


def _decode(recording: Recording) -> TrackedRecording:
    """The pictures up to the first unreadable one."""
    tracked = TrackedRecording()
    with suppress(UserError):  # tracking reports it
        for picture in recording.frames():
            tracked.decoded.append((picture.index, picture.time_s))
            tracked.size = picture.rgb.shape[0], picture.rgb.shape[1]
    return tracked
