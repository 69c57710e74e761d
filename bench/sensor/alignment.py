"""Alignment of the force sensor with the video: clock offset, axes, processed samples at frame times."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bench.recording import clocks
from bench.recording.meta import SensorMeta, Span, Sync
from bench.recording.recording_folder import Force, Recording
from bench.sensor import clock_sync, force_sensor
from bench.sensor.clock_sync import Offset
from bench.sensor.drift import Drift, find_drift, remove_drift
from bench.sensor.rotation import SensorRotation, find_rotation
from synth.arrays import Floats
from synth.flow.recording.find_pulse import SurfaceMotion
from synth.flow.recording.finding import Finding


@dataclass(frozen=True)
class AlignedSensor:
    """The sensor at the frames' times, on the video's clock."""

    axes_mn: Floats | None = None  # (T, 3) mN, NaN without samples; None if nothing can be scored
    noise_floor_mn: float = 0.0
    steps: tuple[str, ...] = ()  # of the processing, in order, in words
    offset: Offset | None = None  # found by correlation; None without a search
    rotation: SensorRotation | None = None  # found on `sensor.turn_s`; None without that span
    in_camera_axes: bool = False
    notes: tuple[str, ...] = ()  # for the user
    findings: tuple[Finding, ...] = ()
    drift: Drift | None = None  # of the zero, against the video; None: unknown, or removed
    samples: tuple[Floats, Floats] | None = None  # processed: times (N,) on the video's clock [s], (N, 3) mN

    @property
    def size_mn(self) -> Floats | None:
        """(T,) magnitude [mN]."""
        return None if self.axes_mn is None else np.linalg.norm(self.axes_mn, axis=1)


def align_sensor(
    recording: Recording, time_s: Floats, speed: Floats, surface: SurfaceMotion | None
) -> AlignedSensor:
    """Finds the clocks' offset and the sensor's rotation, and interpolates the sensor at the frames (T,) [s].

    `speed`: (T,) mean speed of the tissue since the frame before [mm/s], NaN where unknown; `surface`: its
    motion over `sensor.turn_s`, None without that span. UserError as `force_sensor.process_force`.
    """
    force, sensor = recording.force, recording.meta.sensor
    if force is None:
        return AlignedSensor()
    if other := clocks.find_other_unit(time_s, force.time_s):
        return AlignedSensor(notes=(f"{other}: nothing is scored",))
    offset_s, offset = _find_offset(force, sensor, recording.meta.sync, time_s, speed)
    rotation, notes, rate = None, list[str](), recording.meta.sync.rate
    if sensor.turn_s is not None:
        rotation = _find_rotation(force, sensor, offset_s, rate, surface)
        if rotation.refused:
            notes = [f"the sensor's rotation was not found ({rotation.refused}): components are not scored"]
        else:
            span = describe_span(sensor.turn_s)
            notes = [f"the sensor's rotation was found on {span}: {rotation.describe()}"]
            sensor = sensor.model_copy(update={"to_camera": rotation.rows})
    processed = force_sensor.process_force(force, sensor, offset_s, rate)
    axes = force_sensor.interpolate_force(processed, time_s)
    count = int(np.isfinite(axes).all(axis=1).sum())
    if 0 < count < len(time_s):
        notes.append(f"the sensor covers {count} of {len(time_s)} frames; only those are scored")
    findings = list[Finding]()
    if offset is not None and offset.refused:
        fallback = f"scored with the stated offset of {offset_s:g} s"
        message = f"the clocks could not be aligned ({offset.refused}): {fallback}"
        findings = [Finding("warning", "clocks", message)]
    values = processed.noise_floor_mn, processed.steps, offset, rotation, sensor.in_camera_axes, tuple(notes)
    samples = processed.time_s, processed.force_mn
    return AlignedSensor(axes if count else None, *values, tuple(findings), samples=samples)


def judge_drift(sensor: AlignedSensor, meta: SensorMeta, time_s: Floats, moved: Floats) -> AlignedSensor:
    """The sensor with the drift of its zero against the video, or without that drift if `meta` says so.

    `time_s`: (T,) of the frames [s]; `moved`: (T,) mean motion of the tissue since the rest frame, any unit,
    NaN where unknown.
    """
    if sensor.axes_mn is None:
        return sensor
    drift = find_drift(time_s, sensor.axes_mn, moved, sensor.samples)
    if drift is None:
        return sensor
    if meta.drift == "keep":
        return replace(sensor, drift=drift)
    step = f"drift of {drift.change_mn:.2g} mN removed, from {len(drift.time_s)} spans at rest in the video"
    steady = remove_drift(time_s, sensor.axes_mn, drift)
    return replace(sensor, axes_mn=steady, steps=(*sensor.steps, step))


def describe_span(span: Span) -> str:
    """A span [s] in words."""
    return f"{span[0]:g} to {span[1]:g} s"


def _find_offset(
    force: Force, sensor: SensorMeta, sync: Sync, time_s: Floats, speed: Floats
) -> tuple[float, Offset | None]:
    """The offset to add to the sensor's times [s], and the search for it if there was one."""
    if sync.method == "clock":
        return 0.0, None
    if sync.method == "offset" or sync.calibration_s is None:
        return sync.offset_s, None
    inside = (time_s >= sync.calibration_s[0]) & (time_s <= sync.calibration_s[1])
    smooth = force_sensor.process_force(force, sensor, 0.0, sync.rate)
    samples = smooth.time_s, smooth.force_mn
    offset = clock_sync.find_offset(time_s[inside], speed[inside], *samples, sync.search_s)
    return sync.offset_s if offset.refused else offset.offset_s, offset


def _find_rotation(
    force: Force, sensor: SensorMeta, offset_s: float, rate: float, surface: SurfaceMotion | None
) -> SensorRotation:
    """The rotation to the camera's axes for which the tissue moves along the force."""
    if surface is None:
        return find_rotation(np.zeros((0, 1, 2)), np.zeros((0, 1)), np.zeros((0, 3)))
    count = len(surface.time_s)
    moved, visible = (np.stack(parts).astype(np.float64) for parts in (surface.motion, surface.visible))
    processed = force_sensor.process_force(force, sensor, offset_s, rate)
    force_mn = force_sensor.interpolate_force(processed, np.array(surface.time_s))
    return find_rotation(moved.reshape(count, -1, 2), visible.reshape(count, -1), force_mn)
