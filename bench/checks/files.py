"""Checks of a recording's files and pictures, and of scale and E: force is proportional to E scale²."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from bench.recording.recording_folder import Recording
from bench.tracking.tracking import TrackedRecording
from synth.errors import UserError
from synth.flow.recording.finding import Finding, judge_scale, judge_young
from synth.flow.recording.pair_findings import judge_pair
from synth.video.read_video import VideoFile, find_length, find_start

_FEW = 0.02  # share of the frames lost, from which it is a warning; by hand
_MASKS_READ, _INVERTED = 5, 0.5  # masks looked at; median white share that no instrument has; by hand
_SPARE_S, _SPARE_STEPS = 0.5, 5  # by which a stated length may exceed the last time; by hand
_MANY = 0.2  # share of the tissue masked, from which to check the recording; by hand
_LEAST_TISSUE = 0.05  # share of the picture; by hand
_NO_YOUNG = (
    "Young's modulus unknown: forces are those of tissue of 1 kPa, so only scores that are independent of a "
    "factor are reported, and those after the gain of a separate press if there is one"
)
_WRONG_TISSUE = (
    "what a wrong tissue costs: masks that held half of it to a twentieth changed the force that physics "
    "finds with one camera by factors of 0.3 to 1.6 in three rendered recordings"
)


def check_notes(recording: Recording) -> list[Finding]:
    """Findings on oddities of the files, which were handled when the recording was opened."""
    return [Finding("warning", "files", note) for note in recording.notes]


def check_tool(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on masks of the tool."""
    message = recording.describe_tool(len(tracked.decoded))
    findings = [Finding("ok" if recording.masks else "missing", "tool", message)]
    numbers, shares = [number for number, _ in tracked.decoded], []
    for k in np.linspace(0, len(numbers) - 1, min(_MASKS_READ, len(numbers))).astype(int):
        with suppress(UserError):  # tracking reports it
            mask = recording.masks.read(numbers[k], tracked.size)
            shares += [] if mask is None else [float(mask.mean())]
    if shares and (share := float(np.median(shares))) > _INVERTED:
        doubt = f"the masks are white on {100 * share:.0f}% of the picture, as if on the tissue: invert them"
        findings.append(Finding("warning", "tool", doubt))
    return findings


def check_pictures(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on number and size of the pictures, and those that tracking collects."""
    height, width = tracked.size
    message = f"{len(tracked.decoded)} frames of {width} x {height} px"
    findings = [Finding("ok", "pictures", message)] * bool(tracked.decoded) + tracked.findings
    times = [time_s for _, time_s in tracked.decoded if time_s is not None]
    if isinstance(recording.footage, VideoFile) and recording.times_s is None and len(times) > 1:
        with suppress(UserError):  # reading the pictures reports it
            stated_s = find_length(recording.footage)
            end_s = max(times) + _SPARE_STEPS * (max(times) - min(times)) / (len(times) - 1)
            late_s = 0.0 if recording.footage.from_file else find_start(recording.footage)
            if stated_s > end_s + max(late_s, _SPARE_S):
                fault = f"the video states {stated_s:.2f} s, but its pictures end at {max(times):.2f} s"
                findings.append(
                    Finding("warning", "pictures", f"{fault}: it is cut off or damaged, copy it again")
                )
    return findings


def check_tracking(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on masked tissue and lost frames."""
    summary = tracked.summary
    is_doubtful = summary.shares["masked"] > _MANY or summary.shares["lost"] > _FEW
    message = summary.describe()
    return [Finding("warning" if is_doubtful else "ok", "tracking", message)] if summary.frames else []


def check_stiffness(recording: Recording) -> list[Finding]:
    """Findings on Young's modulus: unknown, or implausible for tissue."""
    meta = recording.meta
    if meta.young_kpa is None:
        return [Finding("missing", "stiffness", _NO_YOUNG)]
    stated = f"E = {meta.young_kpa:g} kPa ± {100 * meta.young_uncertainty:.2g}%"
    doubts = judge_young(meta.young_kpa, meta.tissue == "phantom")
    return doubts or [Finding("ok", "stiffness", stated)]


def check_scale(recording: Recording) -> list[Finding]:
    """Findings on the stated, calibrated or measured scale."""
    try:
        scale = recording.scale
    except UserError as error:
        return [Finding("error", "scale", str(error))]
    message = f"{scale.mm_per_px:.4g} mm/px ± {100 * scale.uncertainty:.2g}% ({scale.source})"
    return [Finding("ok", "scale", message)]


def check_tissue(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on a stated tissue that is too small to be one, and on the cost of a found one in doubt."""
    if recording.tissue is None:
        doubts = {"error", "warning"} & {
            finding.severity for finding in tracked.findings if finding.cause == "tissue"
        }
        return [Finding("missing", "tissue", _WRONG_TISSUE)] if doubts else []
    if not tracked.decoded:
        return []
    try:
        share = float(recording.tissue_mask(tracked.size).mean())
    except UserError:  # tracking reports it
        return []
    if share >= _LEAST_TISSUE:
        return []
    message = f"tissue.png is white on {100 * share:.2g}% of the picture: draw all of the tissue"
    return [Finding("warning", "tissue", message)]


def check_pair(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on the right or depth camera."""
    if tracked.stereo is None:
        return []
    return judge_pair(tracked.stereo, None if recording.meta.is_scale_measured else tracked.scale_mm_per_px)


def check_field_of_view(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on the width of the picture in millimetres."""
    return judge_scale(tracked.scale_mm_per_px, tracked.size[1])
