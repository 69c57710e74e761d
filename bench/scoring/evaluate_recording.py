"""Scoring of methods on a recording: tracking, alignment of the sensor, checks, scores of selected frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bench.checks.judgement import judge
from bench.checks.sensor import find_sensor_motion
from bench.methods.flow_size import FlowSize, flow_sizes
from bench.methods.method_interface import Method
from bench.recording.meta import Meta, Span
from bench.recording.recording_folder import Recording
from bench.recording.recording_scale import PixelScale
from bench.scoring import force_metrics
from bench.scoring.result import Gain, MethodScore, Result
from bench.sensor.alignment import AlignedSensor, align_sensor, describe_span, judge_drift
from bench.tracking.tracking import Progress, TrackedRecording, track_recording
from learn.uncertainty.intervals import LEVEL
from synth.arrays import Array, Floats, Mask
from synth.flow.estimator import name_backend
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.finding import by_severity, first_fault, problems
from synth.flow.recording.flow import LocalFlow

_MOVED = 0.1  # change of force, as a share of the peak, from which unchanged pictures are frozen ones
_SEED = 0  # of the bootstrap, for reproducible intervals


def evaluate_recording(
    recording: Recording,
    methods: Mapping[str, Method],
    main: str,
    scale: PixelScale,
    settings: RecordingFlowSettings,
    description: Mapping[str, Any],
    progress: Progress = lambda done: None,
    flow: LocalFlow | None = None,
) -> Result:
    """Tracks the recording and scores every method against its sensor.

    `methods`: by name, in the table's order, with `main`, which the report is about; `description`: their
    properties. `progress`, `flow`, UserError: as of `track_recording`; UserError also of `process_force`.
    """
    # The lengths of flow are the least that a method should exceed.
    methods = {main: methods[main], **flow_sizes(), **methods}
    tracked = track_recording(
        recording, methods, scale.mm_per_px, settings, pictured=main, flow=flow, progress=progress
    )
    meta, time_s = recording.meta, np.array(tracked.time_s)
    lost = ~np.array(tracked.trusted)
    # Since the frame before, which may be lost too.
    speed = np.where(lost | np.append(False, lost[:-1]), np.nan, tracked.speed)
    sensor = align_sensor(recording, time_s, speed, tracked.turning)
    motion_mm = np.array(next(tracked.force_mn[name] for name in flow_sizes()))[:, 0]
    sensor = judge_drift(sensor, meta.sensor, time_s, np.where(lost, np.nan, motion_mm))
    scored, unscored = _select_frames(meta, tracked, sensor)
    sensor_motion = find_sensor_motion(recording, tracked, methods, main, sensor, scored)
    findings = by_severity([*tracked.doubt, *judge(recording, tracked, sensor_motion), *sensor.findings])
    missing = [finding.message for finding in findings if finding.severity == "missing"]
    result = Result(
        recording=recording.name,
        main=main,
        time_s=time_s,
        sensor_mn=sensor.size_mn,
        sensor_axes_mn=sensor.axes_mn,
        methods={},
        scale=scale,
        relative_uncertainty=math.hypot(2 * scale.uncertainty, meta.young_uncertainty),
        noise_floor_mn=sensor.noise_floor_mn,
        scored=scored,
        lost=lost | bool(first_fault(findings)),
        sync=sensor.offset,
        notes=(*missing, *tracked.notes, *sensor.notes, *unscored),
        steps=sensor.steps,
        settings=vars(settings)
        | {"backend": name_backend(settings.backend), **description}
        | {"meta": meta.model_dump(mode="json", exclude_none=True)},
        tracked=tracked,
        turn=sensor.rotation,
        findings=problems(findings),
        absolute=meta.young_kpa is not None,
    )
    press = None if meta.press_s is None else _within(time_s, meta.press_s)
    return replace(result, methods=_score_methods(methods, result, press, sensor.in_camera_axes))


def _select_frames(meta: Meta, tracked: TrackedRecording, sensor: AlignedSensor) -> tuple[Mask, list[str]]:
    """Frames (T,) to score, not those that something is calibrated on, nor repeated pictures; and notes."""
    time_s = np.array(tracked.time_s)
    notes: list[str] = []
    scored = np.ones(len(time_s), bool)
    for purpose, span in (
        ("clock calibration", meta.sync.calibration_s),
        ("sensor's rotation", meta.sensor.turn_s),
        ("press", meta.press_s),
    ):
        if span is not None:
            inside = _within(time_s, span)
            scored &= ~inside
            notes.append(f"{inside.sum()} frames of the {purpose} ({describe_span(span)}) are not scored")
    if lost := tracked.trusted.count(False):
        notes.append(f"tracking was lost in {lost} of {len(time_s)} frames: they are not scored")
    repeats = _find_repeats(tracked, sensor.size_mn)
    if repeats.any():
        notes.append(f"{repeats.sum()} frames show an earlier one again, frozen or repeated: not scored")
    return scored & ~repeats, notes


def _within(time_s: Floats, span: Span) -> Mask:
    return (time_s >= span[0]) & (time_s <= span[1])


def _find_repeats(tracked: TrackedRecording, sensor_mn: Floats | None) -> Mask:
    """Frames (T,) with the picture of the tracked frame before: identical, or frozen while force changed."""
    pairs = list(zip(tracked.frame, [-1, *tracked.frame[:-1]], strict=True))
    # Repeats of frames that were not tracked do not count.
    identical, frozen = (
        np.array([k in originals and originals[k] <= before for k, before in pairs])
        for originals in tracked.repeats
    )
    if sensor_mn is not None and frozen.any():
        peak = float(np.nanmax(np.abs(sensor_mn), initial=0.0))
        for run in np.split(np.arange(len(frozen)), np.flatnonzero(np.diff(frozen)) + 1):
            if frozen[run[0]] and np.ptp(sensor_mn[max(run[0] - 1, 0) : run[-1] + 1]) > _MOVED * peak:
                identical[run] = True
    return np.asarray(identical, bool)


def _score_methods(
    methods: Mapping[str, Method], result: Result, press: Mask | None, in_camera_axes: bool
) -> dict[str, MethodScore]:
    """Scores of each method by name, the main one first.

    `result`: the result without methods; `press`: (T,) frames of the calibrating press; `in_camera_axes`: as
    of `AlignedSensor`.
    """
    scores: dict[str, MethodScore] = {}
    for name, method in methods.items():
        force, gain = np.array(result.tracked.force_mn[name], np.float64), None
        size = np.array(result.tracked.size_mn[name], np.float64)
        first = scores.get(result.main)
        force[result.lost], size[result.lost] = np.nan, np.nan
        if isinstance(method, FlowSize):
            gain = _fit_gain(size, first, result, press)
            force, size = gain.mn_per_mm * force, gain.mn_per_mm * size
        score = replace(_score(force, size, first, result, press, in_camera_axes), gain=gain)
        scores[name] = _add_interval(score, name, result)
    return scores


def _fit_gain(size: Floats, first: MethodScore | None, result: Result, press: Mask | None) -> Gain:
    """The gain from a length of flow, (T,) mm, to force, as of `Gain.source`."""
    sensor = result.sensor_mn
    if sensor is None:
        target = size if first is None else first.size_mn
        return Gain(force_metrics.gain(target, size, np.ones(len(size), bool)), result.main)
    if press is not None and math.isfinite(press_gain := force_metrics.gain(sensor, size, press)):
        return Gain(press_gain, "press")
    return Gain(force_metrics.gain(sensor, size, result.scored), "hindsight")


def _score(
    force: Floats,
    size: Floats,
    first: MethodScore | None,
    result: Result,
    press: Mask | None,
    in_camera_axes: bool,
) -> MethodScore:
    """Scores one method's force (T, 3) and its magnitude (T,) against the sensor.

    `first`: the main method, if this is another.
    """
    sensor, used = result.sensor_mn, result.scored
    axes = result.sensor_axes_mn
    if sensor is None or axes is None:
        return MethodScore(force, size)
    x, y = sensor[used], size[used]
    scores, events = force_metrics.compute_all(result.time_s, sensor, size, result.noise_floor_mn, used)
    components: dict[str, dict[str, float]] = {}
    if in_camera_axes and np.isfinite(force).any(axis=0).all():
        components = {
            axis: force_metrics.agreement(axes[used, k], force[used, k]) for k, axis in enumerate("xyz")
        }
    rng = np.random.default_rng(_SEED)
    intervals = force_metrics.agreement_intervals(x, y, rng)
    excess = None if first is None else force_metrics.difference_interval(x, first.size_mn[used], y, rng)
    if not result.absolute:
        scores, events = force_metrics.without_newtons(scores), force_metrics.without_prediction(events)
        components = {axis: force_metrics.without_newtons(values) for axis, values in components.items()}
        intervals, excess = {key: intervals[key] for key in intervals if key in force_metrics.RELATIVE}, None
    calibrated: dict[str, float] = {}
    if press is not None:
        gain = force_metrics.gain(sensor, size, press)
        calibrated = {"gain": gain, **force_metrics.agreement(x, gain * y)}
        calibrated["mae_of_peak"] = force_metrics.ratio(calibrated["mae_mn"], scores["event_peak_mn"])
    return MethodScore(force, size, scores, components, events, intervals, calibrated, excess)


def _add_interval(score: MethodScore, name: str, result: Result) -> MethodScore:
    """Adds the method's prediction intervals, their level, mean width and coverage of the sensor."""
    low, high = np.where(result.lost, np.nan, np.array(result.tracked.bounds[name], np.float64).T)
    known = np.isfinite(low)
    if not known.any():
        return score
    known &= result.scored
    interval = {} if name in result.tracked.uncalibrated else {"level": LEVEL}
    interval["width_mn"] = _mean((high - low)[known])
    sensor = result.sensor_mn
    if sensor is not None and result.absolute:
        known &= np.isfinite(sensor)
        interval["coverage"] = _mean(((sensor >= low) & (sensor <= high))[known])
    return replace(score, low_mn=low, high_mn=high, interval=interval)


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else math.nan
