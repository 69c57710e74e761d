"""Checks of a recording's files and pictures."""

from __future__ import annotations

from bench.recording.folder import Recording
from bench.tracking.tracking import TrackedRecording
from synth.recording_flow.finding import Finding

_FEW = 0.02  # share of the frames lost, from which it is a warning; by hand
_MANY = 0.2  # share of the tissue masked, from which to check the recording; by hand


def check_notes(recording: Recording) -> list[Finding]:
    """Findings on oddities of the files, which were handled when the recording was opened."""
    return [Finding("warning", "files", note) for note in recording.notes]


def check_tool(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on masks of the tool."""
    message = recording.describe_tool(len(tracked.decoded))
    return [Finding("ok" if recording.masks else "missing", "tool", message)]


def check_pictures(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on number and size of the pictures, and those that tracking collects."""
    height, width = tracked.size
    message = f"{len(tracked.decoded)} frames of {width} x {height} px"
    return [Finding("ok", "pictures", message)] * bool(tracked.decoded) + tracked.findings


def check_tracking(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on masked tissue and lost frames."""
    summary = tracked.summary
    many = summary.shares["masked"] > _MANY or summary.shares["lost"] > _FEW
    message = summary.describe()
    return [Finding("warning" if many else "ok", "tracking", message)] if summary.frames else []
