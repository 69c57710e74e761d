"""A recording and methods in, a scored result out: what `bench score` does."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench import bootstrap
from bench.bootstrap import Interval
from bench.methods.flow_size import FlowSize, flow_sizes
from bench.methods.protocol import Method
from bench.recording import clocks
from bench.recording.folder import Force, Recording
from bench.recording.meta import Sensor, Span
from bench.recording.pixel_scale import Scale
from bench.scoring import metrics
from bench.sensor import clock_sync, force_sensor
from bench.sensor.clock_sync import Offset
from bench.sensor.rotation import Turn, find_turn
from bench.tracking.tracking import Progress, Tracked, track_recording
from learn.inference.force_reader import describe_unseen
from learn.uncertainty.intervals import LEVEL
from synth.dataset.folder import write_whole
from synth.recording_flow.video_flow import FlowHere
from synth.recording_flow.video_flow import Settings as Settings
from synth.system import packages

Curve = NDArray[np.float64]
_SEED = 0  # of the bootstrap: the same recording gives the same intervals
MOST_LOST = 0.2
"""Share of lost frames above which no number stands for a recording: the rest are the easy ones."""
_NO_YOUNG = (
    "Young's modulus unknown: forces are those of tissue of 1 kPa, so only scores that no factor changes are "
    "given, and those after the gain of a separate press if there is one"
)


@dataclass(frozen=True)
class Gain:
    """The one factor that makes a force of a length of flow."""

    mn_per_mm: float
    """NaN where nothing determines it."""
    source: str
    """`press`: the separate one. `hindsight`: the scored frames themselves, the best there is. Without a
    sensor the name of the method whose curve it was brought to."""


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
    gain: Gain | None = None
    """Of a baseline that has no newtons of its own; None for all others."""
    low_mn: Curve | None = None
    """(T,) lower end of the 90% interval of the size [mN]; None of a method that knows none."""
    high_mn: Curve | None = None
    """(T,) upper end."""
    held: dict[str, float] = field(default_factory=dict)
    """What that interval came to: `level`, mean `width_mn` and, where the sensor says, `coverage`."""


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
    """One standard deviation of every force, from scale (whose square force goes with) and stiffness."""
    noise_floor_mn: float
    scored: NDArray[np.bool_]
    """(T,) whether the frame counts: calibration spans don't."""
    lost: NDArray[np.bool_]
    """(T,) whether the frame could not be followed: no method has an answer there."""
    sync: Offset | None
    """What the search for the clocks' offset found; None if they weren't searched."""
    notes: tuple[str, ...]
    steps: tuple[str, ...]
    settings: dict[str, Any]
    environment: dict[str, str]
    followed: Tracked
    turn: Turn | None = None
    """The sensor's rotation as found on `sensor.turn_s`; None if it was stated, or nobody asked."""
    absolute: bool = True
    """Whether E is known, so that forces are in newtons and not those of tissue of 1 kPa."""

    @property
    def aligned(self) -> bool:
        """Whether the clocks are as stated, or were found; not where the search had to be refused."""
        return self.sync is None or not self.sync.refused

    @property
    def lost_share(self) -> float:
        """Share of the frames to be scored that were lost."""
        return float(self.lost[self.scored].mean()) if self.scored.any() else 0.0


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
    # Whoever is scored has these two to beat.
    methods = {main: methods[main], **flow_sizes(), **methods}
    done = track_recording(
        recording, methods, scale.mm_per_px, settings, pictured=main, flow=flow, progress=progress
    )
    meta = recording.meta
    time = np.array(done.time_s)
    notes = [*recording.notes, *done.notes]
    truth = _truth(recording, done, time, notes)
    if meta.young_kpa is None:
        notes.append(_NO_YOUNG)
    kept = _kept(recording, time, notes)
    forces, lost = _with_gaps(done, notes)
    bounds = _bounds(done, lost, notes)
    gains = _brought_to_newtons(forces, methods, truth, kept, _pressed(recording, time), main)
    scored, absolute = {}, meta.young_kpa is not None
    for name, force in forces.items():
        one = _scored(time, force, None if name == main else forces[main], truth, kept, recording)
        held = _held(bounds.get(name), truth.size_mn, kept, absolute)
        scored[name] = replace(one, gain=gains.get(name), **held)
    return Result(
        recording=recording.name,
        main=main,
        time_s=time,
        sensor_mn=truth.size_mn,
        sensor_axes_mn=truth.axes_mn,
        methods=scored,
        scale=scale,
        relative_uncertainty=math.hypot(2 * scale.uncertainty, meta.young_uncertainty),
        noise_floor_mn=truth.floor_mn,
        scored=kept,
        lost=lost,
        sync=truth.sync,
        notes=tuple(notes),
        steps=truth.steps,
        settings={**asdict(settings), **described, "meta": meta.model_dump(mode="json", exclude_none=True)},
        environment=environment(),
        followed=done,
        turn=truth.turn,
        absolute=absolute,
    )


def _with_gaps(done: Tracked, notes: list[str]) -> tuple[dict[str, Curve], NDArray[np.bool_]]:
    """Each method's forces (T, 3), NaN in frames that could not be followed, and those, (T,)."""
    lost = ~np.array(done.trusted)
    if lost.any():
        notes.append(f"{lost.sum()} of {len(lost)} frames could not be followed: gaps, not scored")
    forces = {name: np.array(curve, np.float64) for name, curve in done.force_mn.items()}
    for force in forces.values():
        force[lost] = np.nan
    return forces, lost


def _bounds(done: Tracked, lost: NDArray[np.bool_], notes: list[str]) -> dict[str, Curve]:
    """Ends of each method's interval, (T, 2), NaN in lost frames; of the methods that know any."""
    found = {}
    for name, rows in done.bounds.items():
        table = np.array(rows, np.float64)
        table[lost] = np.nan
        if np.isfinite(table[:, 0]).any():
            found[name] = table[:, :2]
            notes += [f"{name}: {said}" for said in describe_unseen(table[np.isfinite(table[:, 2]), 2])]
    return found


def _held(
    ends: Curve | None, sensor_mn: Curve | None, kept: NDArray[np.bool_], absolute: bool
) -> dict[str, Any]:
    """Ends of a method's intervals, (T, 2), and what they hold of the sensor's scored frames."""
    if ends is None:
        return {}
    low, high = ends[:, 0], ends[:, 1]
    said = kept & np.isfinite(low)
    held = {"level": LEVEL, "width_mn": float((high - low)[said].mean()) if said.any() else math.nan}
    if sensor_mn is not None and absolute:
        said &= np.isfinite(sensor_mn)
        within = (sensor_mn >= low) & (sensor_mn <= high)
        held["coverage"] = float(within[said].mean()) if said.any() else math.nan
    return {"low_mn": low, "high_mn": high, "held": held}


def _pressed(recording: Recording, time: Curve) -> NDArray[np.bool_] | None:
    """(T,) the frames of the calibrating press; None if there is none."""
    span = recording.meta.press_s
    return None if span is None else (time >= span[0]) & (time <= span[1])


def _brought_to_newtons(
    forces: Mapping[str, Curve],
    methods: Mapping[str, Method],
    truth: _Truth,
    kept: NDArray[np.bool_],
    press: NDArray[np.bool_] | None,
    main: str,
) -> dict[str, Gain]:
    """Multiplies, in place, each length of flow by its one gain.

    On the press if there is one. Else in hindsight, which flatters: a method that loses against that may
    only lack a gain, one that follows the sensor less well lacks more.
    """
    gains = {}
    for name in (name for name, method in methods.items() if isinstance(method, FlowSize)):
        size = _length(forces[name])
        if truth.size_mn is None:
            gain = Gain(metrics.gain(_length(forces[main]), size, np.ones(len(size), bool)), main)
        else:
            gain = Gain(float("nan"), "")
            if press is not None:
                gain = Gain(metrics.gain(truth.size_mn, size, press), "press")
            if not math.isfinite(gain.mn_per_mm):
                gain = Gain(metrics.gain(truth.size_mn, size, kept), "hindsight")
        forces[name][:] *= gain.mn_per_mm
        gains[name] = gain
    return gains


def _kept(recording: Recording, time: Curve, notes: list[str]) -> NDArray[np.bool_]:
    """(T,) whether a frame is scored: those that something was calibrated on are not."""
    meta, kept = recording.meta, np.ones(len(time), bool)
    calibrating = (
        ("calibration of the clocks", meta.sync.calibration_s),
        ("sensor's rotation", meta.sensor.turn_s),
        ("press", meta.press_s),
    )
    for what, span in calibrating:
        if span is not None:
            inside = (time >= span[0]) & (time <= span[1])
            kept &= ~inside
            notes.append(f"{inside.sum()} frames of the {what} ({_words(span)}) are not scored")
    return kept


@dataclass(frozen=True)
class _Truth:
    """The sensor at the frames' times."""

    axes_mn: Curve | None = None
    floor_mn: float = 0.0
    steps: tuple[str, ...] = ()
    sync: Offset | None = None
    turn: Turn | None = None
    in_camera_axes: bool = False

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
            notes.append(
                f"clocks could not be aligned ({found.refused}): scored at the offset stated, {offset:g} s"
            )
        else:
            offset = found.offset_s
    sensor, turn = meta.sensor, None
    if sensor.turn_s is not None:
        turn = _turn(force, sensor, offset, done)
        if turn.refused:
            notes.append(f"no rotation of the sensor found ({turn.refused}): components are not scored")
        else:
            notes.append(f"the sensor's rotation was found on {_words(sensor.turn_s)}: {turn.describe()}")
            sensor = sensor.model_copy(update={"to_camera": turn.rows})
    processed = force_sensor.process_force(force, sensor, offset)
    axes = force_sensor.force_at(processed, time)
    covered = int(np.isfinite(axes).all(axis=1).sum())
    if covered == 0:
        notes.append("force.csv and the video share no time: predictions only; are both clocks in seconds?")
        return _Truth(steps=processed.steps, sync=found, turn=turn)
    other = clocks.find_other_unit(time, force.time_s)
    if other:
        notes.append(f"{other}: predictions only, nothing is scored")
        return _Truth()
    if covered < len(time):
        notes.append(f"the sensor covers {covered} of {len(time)} frames; only those are scored")
    return _Truth(axes, processed.noise_floor_mn, processed.steps, found, turn, sensor.in_camera_axes)


def _offset(force: Force, recording: Recording, done: Tracked, time: Curve) -> Offset:
    about = recording.meta.sync
    assert about.calibration_s is not None
    inside = (time >= about.calibration_s[0]) & (time <= about.calibration_s[1])
    smooth = force_sensor.process_force(force, recording.meta.sensor, 0.0)
    trusted = np.array(done.trusted)
    # A speed is of two frames: where either is lost it is of the flow's mistake.
    speed = np.where(trusted & np.append(True, trusted[:-1]), done.speed, np.nan)
    return clock_sync.find_offset(time[inside], speed[inside], smooth.time_s, smooth.force_mn, about.search_s)


def _turn(force: Force, sensor: Sensor, offset_s: float, done: Tracked) -> Turn:
    """The sensor's rotation to the camera's axes, from how the tissue moved over `sensor.turn_s`."""
    if done.turning is None:
        return find_turn(np.zeros((0, 1, 2)), np.zeros((0, 1)), np.zeros((0, 3)))
    moved, seen = (np.stack(parts).astype(np.float64) for parts in (done.turning.moved, done.turning.seen))
    count, time = len(seen), np.array(done.turning.time_s)
    processed = force_sensor.process_force(force, sensor, offset_s)
    return find_turn(
        moved.reshape(count, -1, 2), seen.reshape(count, -1), force_sensor.force_at(processed, time)
    )


def _words(span: Span) -> str:
    return f"{span[0]:g} to {span[1]:g} s"


def _scored(
    time_s: Curve,
    force: Curve,
    main: Curve | None,
    truth: _Truth,
    kept: NDArray[np.bool_],
    recording: Recording,
) -> Scored:
    """One method's scores; `main`: (T, 3) the force of the one it is compared with."""
    length, size, axes = _length(force), truth.size_mn, truth.axes_mn
    if size is None or axes is None:
        return Scored(force, length, {}, {}, [], {}, {}, None)
    x, y = size[kept], length[kept]
    scores, events = metrics.compute_all(time_s, size, length, truth.floor_mn, kept)
    components: dict[str, dict[str, float]] = {}
    if truth.in_camera_axes and np.isfinite(force).any(axis=0).all():
        components = {axis: metrics.agreement(axes[kept, k], force[kept, k]) for k, axis in enumerate("xyz")}
    rng = np.random.default_rng(_SEED)
    intervals = bootstrap.agreement(x, y, rng)
    worse = None if main is None else bootstrap.difference(x, _length(main)[kept], y, rng)
    absolute = recording.meta.young_kpa is not None
    if not absolute:
        scores, events = metrics.without_newtons(scores), metrics.without_prediction(events)
        components = {axis: metrics.without_newtons(values) for axis, values in components.items()}
        intervals, worse = {key: intervals[key] for key in intervals if key in metrics.RELATIVE}, None
    calibrated: dict[str, float] = {}
    press = _pressed(recording, time_s)
    if press is not None:
        gain = metrics.gain(size, length, press)
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
        "lost": {"frames": int(result.lost.sum()), "share": result.lost_share, "most": MOST_LOST},
        "scores": result.methods[result.main].scores,
        "methods": {
            name: {
                **({"interval": m.held} if m.held else {}),
                "scores": m.scores,
                "intervals": m.intervals,
                "calibrated": m.calibrated,
                "worse_by_mn": m.worse_by_mn,
                "gain": None if m.gain is None else asdict(m.gain),
                "components": m.components,
                "events": m.events,
            }
            for name, m in result.methods.items()
        },
        "scale": asdict(result.scale),
        "relative_uncertainty": result.relative_uncertainty,
        "noise_floor_mn": result.noise_floor_mn,
        "fault": done.fault,
        "pulse": done.pulse,
        "second_eye": None if done.sight is None else asdict(done.sight),
        "aligned": result.aligned,
        "sync": None if result.sync is None else asdict(result.sync),
        "turn": None if result.turn is None else asdict(result.turn),
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
            "lost": result.lost,
            "sensor_mn": result.sensor_mn,
            "sensor_axes_mn": result.sensor_axes_mn,
            "confidence": done.confidence,
            "predicted_mn": {name: m.size_mn for name, m in result.methods.items()},
            "predicted_axes_mn": {name: m.force_mn for name, m in result.methods.items()},
            **{end: ends for end in ("low_mn", "high_mn") if (ends := _ends(result, end))},
        },
    }
    plain = _plain(tree)
    assert isinstance(plain, dict)
    return plain


def _ends(result: Result, end: str) -> dict[str, Curve]:
    """By method, one end of its interval; of those that have any."""
    return {name: getattr(m, end) for name, m in result.methods.items() if m.held}


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
