"""The list of all checks, and the findings of a recording by it, for `bench check` and `bench score`."""

from __future__ import annotations

from collections.abc import Callable

from bench.checks import contradiction, files, sensor, times
from bench.checks.sensor import SensorMotion
from bench.recording.recording_folder import Recording
from bench.tracking.tracking import TrackedRecording
from synth.flow.recording.finding import Finding, by_severity, first_fault

# Of the files alone.
RECORDING_CHECKS: tuple[Callable[[Recording], list[Finding]], ...] = (
    files.check_notes,
    files.check_stiffness,
    files.check_scale,
    sensor.check_samples,
    sensor.check_free_spans,
)
# Of the pictures, of which a few or all are tracked.
TRACKED_CHECKS: tuple[Callable[[Recording, TrackedRecording], list[Finding]], ...] = (
    files.check_pictures,
    files.check_tool,
    files.check_tissue,
    files.check_tracking,
    files.check_field_of_view,
    files.check_pair,
    times.check_times,
    times.check_spans,
    times.check_overlap,
    times.check_margin,
    sensor.check_rest_frame,
    sensor.check_start,
)
# Of the aligned sensor against motion and forces in all tracked frames.
SENSOR_CHECKS: tuple[Callable[[SensorMotion], list[Finding]], ...] = (
    contradiction.check_contradiction,
    sensor.check_constant,
    sensor.check_drift,
)


def judge(
    recording: Recording, tracked: TrackedRecording, sensor: SensorMotion | None = None
) -> list[Finding]:
    """Findings of every check, errors first. `tracked`: if that failed, with the decoded pictures only."""
    findings = [finding for check in RECORDING_CHECKS for finding in check(recording)]
    findings += [finding for check in TRACKED_CHECKS for finding in check(recording, tracked)]
    # Forces that are not valid contradict any sensor.
    if sensor is not None and not first_fault(findings):
        findings = [finding for check in SENSOR_CHECKS for finding in check(sensor)] + findings
    return by_severity(findings)
