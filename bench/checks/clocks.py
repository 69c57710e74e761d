"""Checks of the sensor's times against the video's; for its clock see `bench.checks.contradiction`."""

from __future__ import annotations

from bench.checks.times import rising_times
from bench.recording.clocks import find_other_unit
from bench.recording.folder import Recording
from bench.tracking.tracking import TrackedRecording
from synth.recording_flow.finding import Finding

_COVERED = 0.9  # least share of the video that the sensor should cover; by hand


def check_overlap(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on the unit of both clocks, and on the share of the video that the sensor covers."""
    force, t, sync = recording.force, rising_times(tracked), recording.meta.sync
    if force is None or len(t) < 2:
        return []
    if other := find_other_unit(t, force.time_s):
        return [Finding("warning", "clocks", f"{other}: nothing is scored")]
    offset = sync.offset_s if sync.method == "offset" else 0.0
    margin = sync.search_s if sync.method == "correlate" else 0.0
    first, last = force.time_s[0] + offset - margin, force.time_s[-1] + offset + margin
    share = max(min(t[-1], last) - max(t[0], first), 0.0) / (t[-1] - t[0])
    message = f"the sensor covers {100 * share:.0f}% of the video"
    message += "" if share else ": are both clocks in seconds?"
    return [Finding("ok" if share > _COVERED else "warning", "clocks", message)]


def check_margin(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on samples that the search for the clocks' offset lacks."""
    force, sync = recording.force, recording.meta.sync
    if force is None or sync.method != "correlate" or sync.calibration_s is None:
        return []
    (start, stop), t, margin = sync.calibration_s, force.time_s, sync.search_s
    lacks = max(t[0] - (start - margin), (stop + margin) - t[-1], 0.0)
    message = f"force.csv lacks {lacks:.3g} s of sync.calibration_s and {margin:g} s on either side"
    return [Finding("warning", "clocks", message)] if lacks > 0 else []
