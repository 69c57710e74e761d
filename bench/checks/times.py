"""Checks of the frames' times, of the sensor's against them, and of the spans for calibration."""

from __future__ import annotations

import numpy as np

from bench.recording.clocks import find_other_unit
from bench.recording.meta import LEAST_INTERVALS, LEAST_TURNING
from bench.recording.recording_folder import Recording
from bench.tracking.tracking import TrackedRecording
from synth.arrays import Floats
from synth.flow.recording.finding import Finding

# Chosen by hand.
_GAP = 3.0  # median intervals
_RATES_HZ = 0.5, 1000.0  # of frames whose times are in seconds
_TRACKED_HZ = 10.0  # default rate of tracked frames
_CAMERAS_HZ = 15.0, 20.0, 24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 100.0, 120.0, 240.0  # usual rates
_SAME_RATE, _TOGETHER_S, _LEAST_S = 2e-3, 0.2, 5.0  # of a rate; between starts; least record; by hand
_LEFT_OUT = 0.25  # largest share of a calibration span that the search for the offset may leave out
_COVERED = 0.9  # least share of the video that the sensor should cover
_LEAST_PRESS = 5  # frames of a press that determine its gain


def check_times(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on the frames' times: missing, backwards, with gaps or in another unit."""
    t = _rising_times(tracked)
    if len(t) < 2:
        return [Finding("error", "times", "fewer than two frames have a time")]
    # From first to last frame: the median interval misleads where stamps come in bursts.
    steps, rate = np.diff(t), (len(t) - 1) / (t[-1] - t[0])
    findings = [Finding("ok", "times", f"{t[-1] - t[0]:.2f} s at {rate:.4g} frames per second")]
    timeless = sum(time_s is None for _, time_s in tracked.decoded)
    backward = len(tracked.decoded) - timeless - len(t)
    doubts = []
    if timeless or backward:
        doubts.append(f"{timeless} frames without a time, {backward} backwards in time")
    if gaps := int((steps > _GAP * np.median(steps)).sum()):
        doubts.append(f"{gaps} gaps, the longest {steps.max():.3g} s")
    if not _RATES_HZ[0] <= rate <= _RATES_HZ[1]:
        doubts.append(f"{rate:.3g} frames per second: are the times in seconds?")
    return findings + [Finding("warning", "times", doubt) for doubt in doubts]


def check_spans(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on the spans for calibration: too short, or outside the video."""
    meta, t, findings = recording.meta, _rising_times(tracked), []
    if len(t) < 2:
        return []
    rate = min((len(t) - 1) / (t[-1] - t[0]), _TRACKED_HZ)
    clock = meta.sync.calibration_s if meta.sync.method == "correlate" else None
    for name, span, frames in (
        ("sync.calibration_s", clock, LEAST_INTERVALS),
        ("sensor.turn_s", meta.sensor.turn_s, LEAST_TURNING),
        ("press_s", meta.press_s, _LEAST_PRESS),
    ):
        if span is not None:
            inside_s = max(min(span[1], t[-1]) - max(span[0], t[0]), 0.0)
            message = f"{name} covers {inside_s:.3g} s of video; at least {frames / rate:.3g} s are needed"
            findings.append(Finding("ok" if inside_s >= frames / rate else "warning", "spans", message))
    return findings


def check_overlap(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on the unit of both clocks, and on the share of the video that the sensor covers."""
    force, t, sync = recording.force, _rising_times(tracked), recording.meta.sync
    if force is None or len(t) < 2:
        return []
    if other := find_other_unit(t, force.time_s):
        return [Finding("warning", "clocks", f"{other}: nothing is scored")]
    offset = sync.offset_s if sync.method == "offset" else 0.0
    margin = sync.search_s if sync.method == "correlate" else 0.0
    first, last = (
        sync.rate * force.time_s[0] + offset - margin,
        sync.rate * force.time_s[-1] + offset + margin,
    )
    share = max(min(t[-1], last) - max(t[0], first), 0.0) / (t[-1] - t[0])
    message = f"the sensor covers {100 * share:.0f}% of the video"
    message += "" if share else ": are both clocks in seconds?"
    return [
        Finding("ok" if share > _COVERED else "warning", "clocks", message),
        *_check_stamped_rate(t, recording),
    ]


def _check_stamped_rate(t: Floats, recording: Recording) -> list[Finding]:
    """A finding on records whose lengths are as the usual rates of cameras, as if one were stamped for
    another."""
    force, sync = recording.force, recording.meta.sync
    if force is None or sync.rate != 1 or sync.method == "correlate":
        return []
    step = (t[-1] - t[0]) / (len(t) - 1)
    measured_hz, video_s, sensor_s = 1 / step, t[-1] - t[0] + step, float(np.ptp(force.time_s))
    start_together = abs(force.time_s[0] + sync.offset_s * (sync.method == "offset") - t[0]) < _TOGETHER_S
    for taken_hz in _CAMERAS_HZ:
        stamped_hz = min(_CAMERAS_HZ, key=lambda rate: abs(rate / measured_hz - 1))
        if (
            abs(stamped_hz / measured_hz - 1) > _SAME_RATE
            or taken_hz == stamped_hz
            or not start_together
            or sensor_s < _LEAST_S
        ):
            continue
        if abs(sensor_s / video_s * taken_hz / stamped_hz - 1) < max(_SAME_RATE, 1.5 * step / video_s):
            rate = taken_hz / stamped_hz
            return [
                Finding(
                    "warning",
                    "clocks",
                    f"the sensor's record is {1 / rate:.4g} times as long as the video, as if pictures "
                    f"taken at {taken_hz:g} a second were stamped as {stamped_hz:g}: if so, set sync.rate to "
                    f"{rate:.4f}",
                )
            ]
    return []


def check_margin(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on samples that the search for the clocks' offset lacks.

    Intervals that an offset within the search moves off the sensor's record are left out. Of a sensor that
    starts with the video some always are.
    """
    force, sync = recording.force, recording.meta.sync
    if force is None or sync.method != "correlate" or sync.calibration_s is None:
        return []
    (start, stop), t, margin = sync.calibration_s, sync.rate * force.time_s, sync.search_s
    missing_s = max(t[0] - (start - margin), 0.0) + max((stop + margin) - t[-1], 0.0)
    message = f"force.csv lacks {missing_s:.3g} s of sync.calibration_s and {margin:g} s on either side"
    is_much = missing_s > _LEFT_OUT * (stop - start)
    return [Finding("warning", "clocks", message)] if is_much else []


def _rising_times(tracked: TrackedRecording) -> Floats:
    """Times (T,) [s] of the decoded frames whose time is later than all before."""
    t = np.array([time_s for _, time_s in tracked.decoded if time_s is not None], np.float64)
    latest = np.maximum.accumulate(np.append(-np.inf, t[:-1])) if len(t) else t
    return np.asarray(t[t > latest], np.float64)
