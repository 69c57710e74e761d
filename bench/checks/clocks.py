"""Checks of the sensor's clock against the video's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.checks.sensor import LEAST_FRAMES, SensorMotion, correlation
from bench.checks.times import rising_times
from bench.recording.clocks import find_other_unit
from bench.recording.folder import Recording
from bench.tracking.tracking import TrackedRecording
from synth.arrays import Floats
from synth.recording_flow.finding import Finding

_COVERED = 0.9  # least share of the video that the sensor should cover; by hand
# Chosen by hand between the corrupted and the clean recordings of docs/results/scoring/stability.
_RATES = (1.0, 0.9, 0.92, 0.95, 0.97, 1.03, 1.05, 1.08, 1.1)  # of a drifting clock
_LATE_S = 1.5  # largest clock error tried, in both directions
_SURE = 0.96  # correlation of force and motion from which the clock is right
_BETTER = 0.9  # least correlation with the proposed clock
_LEFT = 0.3  # share of (1 - correlation) that may remain with the proposed clock
_TRIED = 30  # largest number of lags in each direction, and of positions of a gap
_PART = 4  # least number of frames before and after a gap
_COMMON = 0.6  # least share of the frames that the proposed clock covers


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


def check_motion(sensor: SensorMotion) -> list[Finding]:
    """Findings on a clock with which the correlation of force and motion would be much higher."""
    t, size, moved = sensor.time_s, sensor.size_mn, sensor.moved
    best, found = _LEFT, ""
    for what, at in _clocks(t) if correlation(size, moved) < _SURE else ():
        inside = (at >= t[0]) & (at <= t[-1])
        if inside.sum() < max(_COMMON * len(at), LEAST_FRAMES):
            continue
        now, other = (correlation(np.interp(clock[inside], t, size), moved[inside]) for clock in (t, at))
        if now < _SURE and other > _BETTER and (1 - other) / (1 - now) < best:
            best = (1 - other) / (1 - now)
            found = f"the correlation of force and motion is {now:.2f}, but {other:.2f} if {what}"
    return [Finding("warning", "clocks", found)] if found else []


def _clocks(time_s: Floats) -> Iterator[tuple[str, Floats]]:
    """Possible faults of the clock, and the frames' times (T,) [s] that follow."""
    frame, since = float(np.median(np.diff(time_s))), time_s - time_s[0]
    yield "the video runs backwards", time_s[-1] - since
    most = round(_LATE_S / frame)
    lags = [k for k in range(-most, most + 1, max(1, 2 * most // _TRIED)) if k]
    # Creep delays the tissue by as much as one frame.
    for k in (0, *(k for k in lags if abs(k) > 1)):
        for rate in _RATES:
            faults = [f"is shifted by {k * frame:+.2f} s"] * bool(k)
            faults += [f"runs {1 / rate:.2f} times as fast"] * (rate != 1)
            if faults:
                yield f"the sensor's clock {' and '.join(faults)}", time_s[0] + since * rate - k * frame
    for k in lags:
        what = f"{abs(k) * frame:.2f} s of the video are {'missing' if k < 0 else 'repeated'}"
        for start in time_s[_PART : -_PART : max(1, len(time_s) // _TRIED)]:
            yield f"{what} at {start:.2f} s", np.where(time_s < start, time_s, time_s - k * frame)
