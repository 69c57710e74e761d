"""A recording and methods in, a scored result out: what `bench score` does."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench import bootstrap
from bench.bootstrap import Interval
from bench.methods.protocol import Method
from bench.recording.folder import Force, Recording
from bench.recording.pixel_scale import Scale
from bench.scoring import metrics
from bench.sensor import clock_sync, force_sensor
from bench.sensor.clock_sync import Offset
from bench.tracking.tracking import Progress, Tracked, track_recording
from learn.inference.video_flow import FlowHere
from learn.inference.video_flow import Settings as Settings
from synth.dataset.folder import write_whole
from synth.system import packages

Curve = NDArray[np.float64]
_SEED = 0  # of the bootstrap: the same recording gives the same intervals


@dataclass(frozen=True)
class Scored:
    """One method on one recording."""

    force_mn: Curve
    """(T, 3) camera axes [mN]."""
    size_mn: Curve
    """(T,) magnitude [mN]."""
    scores: dict[str, float]
    """Empty without a sensor."""
    components: dict[str, dict[str, float]]
    """Agreement by camera axis, when the sensor's axes are the camera's."""
    events: list[dict[str, float]]
    intervals: dict[str, Interval]
    """95% intervals of some scores, frames being resampled in blocks."""
    calibrated: dict[str, float]
    """Scores after one gain found on the separate press, and that gain; empty without a press."""
    worse_by_mn: Interval | None
    """Interval of the main method's MAE minus this one's, paired; None for the main method."""


@dataclass(frozen=True)
class Result:
    """One run."""

    recording: str
    main: str
    """Name of the method that the report is about."""
    time_s: Curve
    sensor_mn: Curve | None
    """(T,) magnitude at the frames' times [mN]."""
    sensor_axes_mn: Curve | None
    """(T, 3)."""
    methods: dict[str, Scored]
    scale: Scale
    relative_uncertainty: float
    """Of every force, from scale and stiffness."""
    noise_floor_mn: float
    scored: NDArray[np.bool_]
    """(T,) whether the frame counts: calibration spans don't."""
    sync: Offset | None
    """What the search for the clocks' offset found; None if they weren't searched."""
    notes: tuple[str, ...]
    steps: tuple[str, ...]
    settings: dict[str, Any]
    environment: dict[str, str]
    followed: Tracked


def evaluate_recording(
    recording: Recording,
    methods: Mapping[str, Method],
    main: str,
    scale: Scale,
    settings: Settings,
    described: Mapping[str, Any],
    progress: Progress = lambda done: None,
    flow: FlowHere | None = None,
) -> Result:
    """Follows the recording and scores every method against its sensor.

    Args:
        recording: the opened recording.
        methods: by name, in the table's order.
        main: the one the report is about.
        scale: the recording's scale.
        settings: of this run.
        described: what the methods are, for the report.
        progress: told after every frame.
        flow: where it is computed; None: here.

    Raises:
        UserError: as `track_recording` and `force_sensor.process_force`.
    """
    done = track_recording(
        recording, methods, scale.mm_per_px, settings, pictured=main, flow=flow, progress=progress
    )
    meta = recording.meta
    time = np.array(done.time_s)
    notes = [*recording.notes, *done.notes]
    truth = _truth(recording, done, time, notes)
    if meta.young_kpa is None:
        notes.append(
            "Young's modulus unknown: forces are those of tissue of 1 kPa, so only scores that no factor "
            "changes are given, and those after the gain of a separate press if there is one"
        )
    kept = _kept(recording, time, notes)
    forces = {name: np.array(curve) for name, curve in done.force_mn.items()}
    return Result(
        recording=recording.name,
        main=main,
        time_s=time,
        sensor_mn=truth.size_mn,
        sensor_axes_mn=truth.axes_mn,
        methods={
            name: _scored(time, force, forces[main], truth, kept, recording, name == main)
            for name, force in forces.items()
        },
        scale=scale,
        relative_uncertainty=math.hypot(scale.uncertainty, meta.young_uncertainty),
        noise_floor_mn=truth.floor_mn,
        scored=kept,
        sync=truth.sync,
        notes=tuple(notes),
        steps=truth.steps,
        settings={**asdict(settings), **described, "meta": meta.model_dump(mode="json", exclude_none=True)},
        environment=environment(),
        followed=done,
    )


def _kept(recording: Recording, time: Curve, notes: list[str]) -> NDArray[np.bool_]:
    """(T,) whether a frame is scored: those that something was calibrated on are not."""
    meta, kept = recording.meta, np.ones(len(time), bool)
    for what, span in (("calibration of the clocks", meta.sync.calibration_s), ("press", meta.press_s)):
        if span is not None:
            inside = (time >= span[0]) & (time <= span[1])
            kept &= ~inside
            notes.append(f"{inside.sum()} frames of the {what} ({span[0]:g} to {span[1]:g} s) are not scored")
    return kept


@dataclass(frozen=True)
class _Truth:
    """The sensor at the frames' times."""

    axes_mn: Curve | None = None
    floor_mn: float = 0.0
    steps: tuple[str, ...] = ()
    sync: Offset | None = None

    @property
    def size_mn(self) -> Curve | None:
        return None if self.axes_mn is None else np.linalg.norm(self.axes_mn, axis=1)


def _truth(recording: Recording, done: Tracked, time: Curve, notes: list[str]) -> _Truth:
    """Finds the clocks' offset, freezes it, processes the sensor and reads it at the frames."""
    force, meta = recording.force, recording.meta
    if force is None:
        notes.append("no force.csv: predictions only, nothing is scored")
        return _Truth()
    offset, found = meta.sync.offset_s, None
    if meta.sync.method == "clock":
        offset = 0.0
    elif meta.sync.method == "correlate":
        found = _offset(force, recording, done, time)
        if found.refused:
            notes.append(f"clocks could not be aligned ({found.refused}): predictions only")
            return _Truth(sync=found)
        offset = found.offset_s
    processed = force_sensor.process_force(force, meta.sensor, offset)
    axes = force_sensor.force_at(processed, time)
    covered = int(np.isfinite(axes).all(axis=1).sum())
    if covered == 0:
        notes.append("force.csv and the video share no time: predictions only; are both clocks in seconds?")
        return _Truth(steps=processed.steps, sync=found)
    if covered < len(time):
        notes.append(f"the sensor covers {covered} of {len(time)} frames; only those are scored")
    return _Truth(axes, processed.noise_floor_mn, processed.steps, found)


def _offset(force: Force, recording: Recording, done: Tracked, time: Curve) -> Offset:
    about = recording.meta.sync
    assert about.calibration_s is not None
    inside = (time >= about.calibration_s[0]) & (time <= about.calibration_s[1])
    smooth = force_sensor.process_force(force, recording.meta.sensor, 0.0)
    return clock_sync.find_offset(
        time[inside], np.array(done.speed)[inside], smooth.time_s, smooth.force_mn, about.search_s
    )


def _scored(
    time_s: Curve,
    force: Curve,
    main: Curve,
    truth: _Truth,
    kept: NDArray[np.bool_],
    recording: Recording,
    is_main: bool,
) -> Scored:
    length, size, axes = _length(force), truth.size_mn, truth.axes_mn
    if size is None or axes is None:
        return Scored(force, length, {}, {}, [], {}, {}, None)
    x, y = size[kept], length[kept]
    scores, events = metrics.compute_all(time_s, size, length, truth.floor_mn, kept)
    components: dict[str, dict[str, float]] = {}
    if recording.meta.sensor.axes == "camera" and np.isfinite(force).any(axis=0).all():
        components = {axis: metrics.agreement(axes[kept, k], force[kept, k]) for k, axis in enumerate("xyz")}
    rng = np.random.default_rng(_SEED)
    intervals = bootstrap.agreement(x, y, rng)
    worse = None if is_main else bootstrap.difference(x, _length(main)[kept], y, rng)
    absolute = recording.meta.young_kpa is not None
    if not absolute:
        scores, events = metrics.without_newtons(scores), []
        components = {axis: metrics.without_newtons(values) for axis, values in components.items()}
        intervals, worse = {key: intervals[key] for key in intervals if key in metrics.RELATIVE}, None
    calibrated: dict[str, float] = {}
    if recording.meta.press_s is not None:
        low, high = recording.meta.press_s
        gain = metrics.gain(size, length, (time_s >= low) & (time_s <= high))
        calibrated = {"gain": gain, **metrics.agreement(x, gain * y)}
        calibrated["mae_of_peak"] = metrics.ratio(calibrated["mae_mn"], scores["event_peak_mn"])
    return Scored(force, length, scores, components, events, intervals, calibrated, worse)


def _length(force: Curve) -> Curve:
    """Size of each force, from the components that there are, (T,) mN."""
    length = np.sqrt(np.nansum(force**2, axis=1))
    length[~np.isfinite(force).any(axis=1)] = np.nan
    return np.asarray(length, np.float64)


def as_json(result: Result) -> dict[str, Any]:
    """The result as JSON-ready values; undefined numbers are null."""
    done = result.followed
    tree = {
        "format": "sulcus-score",
        "version": 1,
        "recording": result.recording,
        "main": result.main,
        "frames": len(result.time_s),
        "scores": result.methods[result.main].scores,
        "methods": {
            name: {
                "scores": m.scores,
                "intervals": m.intervals,
                "calibrated": m.calibrated,
                "worse_by_mn": m.worse_by_mn,
                "components": m.components,
                "events": m.events,
            }
            for name, m in result.methods.items()
        },
        "scale": asdict(result.scale),
        "relative_uncertainty": result.relative_uncertainty,
        "noise_floor_mn": result.noise_floor_mn,
        "sync": None if result.sync is None else asdict(result.sync),
        "notes": list(result.notes),
        "sensor_steps": list(result.steps),
        "settings": result.settings,
        "environment": result.environment,
        "masks": {"kind": result.settings.get("masks"), "frames": done.account.frames, **done.account.shares},
        "timings": done.timings,
        "curve": {
            "frame": done.frame,
            "t_s": result.time_s,
            "scored": result.scored,
            "sensor_mn": result.sensor_mn,
            "sensor_axes_mn": result.sensor_axes_mn,
            "confidence": done.confidence,
            "predicted_mn": {name: m.size_mn for name, m in result.methods.items()},
            "predicted_axes_mn": {name: m.force_mn for name, m in result.methods.items()},
        },
    }
    plain = _plain(tree)
    assert isinstance(plain, dict)
    return plain


def write_json(result: Result, path: Path) -> None:
    """Writes `score.json` whole or not at all."""
    text = json.dumps(as_json(result), indent=1, allow_nan=False)
    write_whole(path, text + "\n", durable=False)


def environment() -> dict[str, str]:
    """What the numbers were made with."""
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        **{name: str(version) for name, version in packages.versions().items()},
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, (float, np.floating)):
        return round(float(value), 9) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value
