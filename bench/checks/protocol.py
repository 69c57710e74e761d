"""The protocol of a first recording: what to record and to measure, and which of it a recording has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy.signal import find_peaks

from bench.recording.recording_folder import Recording
from synth.flow.recording.finding import Finding
from synth.system.checked_file import read_yaml

# Whether a recording has a step of protocol.yaml; of the others its files don't tell.
_IS_IN: Mapping[str, Callable[[Recording], bool]] = {
    "second camera": lambda recording: recording.has_stereo,
    "scale": lambda recording: recording.meta.scale_mm_per_px != "unknown",
    "sensor": lambda recording: (
        recording.force is not None
        and (recording.meta.sensor.in_camera_axes or recording.meta.sensor.turn_s is not None)
    ),
    "stiffness": lambda recording: recording.meta.young_kpa is not None,
    "membrane": lambda recording: recording.meta.membrane != "unknown" or recording.meta.tissue == "phantom",
    "membrane's stiffness": lambda recording: (
        recording.meta.membrane_mn_per_mm is not None
        or recording.meta.membrane == "stripped"
        or recording.meta.tissue == "phantom"
    ),
    "rest": lambda recording: bool(recording.meta.sensor.free_s or recording.meta.pulse.free_s),
    "taps": lambda recording: _has_common_clock(recording),
    "press": lambda recording: recording.meta.press_s is not None,
    "outline": lambda recording: recording.tissue is not None,
}


_TAPS, _TAP_SHARE, _TAP_S = 3, 0.3, 1.0  # taps; least share of the largest change; longest; by hand


def _has_common_clock(recording: Recording) -> bool:
    """Whether both clocks were recorded, their offset is stated, or the sensor shows taps that give it."""
    force, sync = recording.force, recording.meta.sync
    if force is None:
        return False
    if sync.method != "correlate" or sync.calibration_s is None:
        return sync.method == "offset" or recording.times_s is not None
    start, stop = (edge - sync.offset_s for edge in sync.calibration_s)
    t = sync.rate * force.time_s
    inside = (
        (t >= start - sync.search_s) & (t <= stop + sync.search_s) & np.isfinite(force.force_mn).all(axis=1)
    )
    if inside.sum() < 2 * _TAPS:
        return False
    deviation = force.force_mn[inside] - np.median(force.force_mn[inside], axis=0)
    size = np.pad(np.linalg.norm(deviation, axis=1), 1)
    step_s = float(np.median(np.diff(t[inside])))
    limits = {"prominence": _TAP_SHARE * float(size.max()), "width": (None, _TAP_S / max(step_s, 1e-9))}
    return len(find_peaks(size, **limits)[0]) >= _TAPS


def read_steps() -> list[dict[str, str]]:
    """`title`, `how` and `without`, the cost of its absence, of each step in order."""
    steps: list[dict[str, str]] = read_yaml(Path(__file__).with_suffix(".yaml"))
    return steps


def check_protocol(recording: Recording) -> list[Finding]:
    """Findings on the steps: one for all that the recording has, and one for each that it lacks."""
    steps = [(step, _IS_IN[step["title"]](recording)) for step in read_steps() if step["title"] in _IS_IN]
    present = [step["title"] for step, is_present in steps if is_present]
    findings = [
        Finding("ok", "protocol", f"{len(present)} of {len(steps)} steps: {', '.join(present) or 'none'}")
    ]
    for step in (step for step, is_present in steps if not is_present):
        message = f"{step['title']}: without it, {step['without']}. {step['how']}"
        findings.append(Finding("missing", "protocol", message))
    return findings


def as_markdown() -> str:
    """The steps as a list to tick off."""
    line = "- [ ] **{title}**: {how} *Without it:* {without}.\n"
    return "".join(line.format_map(step) for step in read_steps())
