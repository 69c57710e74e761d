"""Checks of the sensor: its samples, load where there should be none; unit, sign and axes against the video.

Loads are of raw samples, because a tare would hide them. No single method is trusted: a fault of the sensor
is assumed only where all methods contradict it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bench.methods.flow_size import FlowSize
from bench.methods.fusion import Fusion
from bench.methods.protocol import Method
from bench.recording.folder import Recording
from bench.sensor.alignment import AlignedSensor
from bench.tracking.tracking import TrackedRecording
from synth.arrays import Floats
from synth.recording_flow.finding import Finding

_SURGICAL_MN = 5000.0  # force on a brain from which the unit is doubtful; by hand
_LOADED = 0.25  # share of the range of force above which the tissue is not at rest; by hand
# Chosen by hand between the corrupted and the clean recordings of docs/results/scoring/stability, which
# reports detections and false alarms.
LEAST_FRAMES = 8
_ODD_UNIT = 12.0  # factor between sensor and all methods, in the same direction
_OTHER_UNIT = 50.0  # such a factor from which no force is reported
_METHODS = 2  # least number that must agree on a unit, since one may be wrong itself
_PRESSED = 0.3  # share of the peak from which frames are used for the unit
_ALIKE = 0.7  # least correlation with the sensor of methods used for the unit
_SIDEWAYS = 0.2  # least share of the force in the observed axes
# Cosine between sensor and methods: largest in the stated axes, least in the proposed axes, least difference.
_DISAGREE, _AGREE, _APART = 0.2, 0.7, 0.5
_CONSTANT = 3  # frames of constant force that are no saturation
_MOVES = 0.25  # share of the largest motion during constant force, from which it is one


def check_samples(recording: Recording) -> list[Finding]:
    """Findings on the sensor's file: its samples, their unit, and whether spans without contact are given."""
    force = recording.force
    if force is None:
        return [Finding("missing", "sensor", "no force.csv: predictions only, nothing is scored")]
    t, most = force.time_s, float(np.nanmax(np.linalg.norm(force.force_mn, axis=1)))
    rate = (len(t) - 1) / (t[-1] - t[0])
    found = [Finding("ok", "sensor", f"{len(t)} samples at {rate:.4g} Hz, up to {most:.3g} mN")]
    if most > _SURGICAL_MN and recording.meta.tissue != "phantom":
        message = f"{most / 1000:.3g} N is a large force for a brain: is force.csv in newtons?"
        found.append(Finding("warning", "sensor", message))
    if not recording.meta.sensor.free_s:
        message = "no sensor.free_s: no tare, no drift correction, no noise floor"
        found.append(Finding("missing", "sensor", message))
    return found


def check_free_spans(recording: Recording) -> list[Finding]:
    """Findings on spans without contact: no samples, or a load."""
    force, found = recording.force, list[Finding]()
    if force is None:
        return found
    known = np.isfinite(force.force_mn).all(axis=1)
    most = float(np.linalg.norm(np.ptp(force.force_mn[known], axis=0)))
    for start, stop in recording.meta.sensor.free_s:
        inside = (force.time_s >= start) & (force.time_s <= stop)
        free = force.force_mn[inside & known]
        if not inside.any():
            message = f"sensor.free_s: no samples between {start:g} and {stop:g} s"
            found.append(Finding("error", "sensor", message))
        elif len(free) > 2:
            low, high = np.percentile(free, (5, 95), axis=0)
            change = float(np.linalg.norm(high - low))
            if change > _LOADED * most:
                message = f"sensor.free_s: force changes by {change:.3g} mN between {start:g} and {stop:g} s"
                found.append(Finding("warning", "sensor", message))
    return found


def check_rest_frame(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on a load at the rest frame, if the offset of the clocks is stated."""
    force, sync, rest_s = recording.force, recording.meta.sync, tracked.rest_s
    if force is None or rest_s is None or sync.method == "correlate":
        return []
    known = np.isfinite(force.force_mn).all(axis=1)
    t = force.time_s[known] + (sync.offset_s if sync.method == "offset" else 0.0)
    size = np.linalg.norm(force.force_mn[known], axis=1)
    least, most = float(size.min()), float(size.max())
    there = float(np.interp(rest_s, t, size))
    if not t[0] <= rest_s <= t[-1] or there - least <= _LOADED * (most - least):
        return []
    lowest = f"the minimum is {least:.3g} mN at {t[size.argmin()]:.3g} s"
    message = f"the sensor measures {there:.3g} mN at the rest frame; {lowest}"
    return [Finding("warning", "rest frame", message)]


@dataclass(frozen=True)
class SensorMotion:
    """The sensor's force, the tissue's motion and the methods' forces in the frames that have all of them."""

    time_s: Floats  # (T,) of the tracked frames [s]
    axes_mn: Floats  # (T, 3) the sensor's force
    moved: Floats  # (T,) mean motion of the tissue since the rest frame, any unit
    forces_mn: tuple[Floats, ...] = ()  # of each method, (T, 3) in the camera's axes; none if E is unknown
    observed_axes: int = 0  # number of camera axes that the video shows; 0 if the sensor has other axes

    @property
    def size_mn(self) -> Floats:
        """(T,) magnitude of the sensor's force."""
        return np.asarray(np.linalg.norm(self.axes_mn, axis=1))

    @property
    def is_constant(self) -> bool:
        """Whether the sensor's force never changes."""
        return not np.ptp(self.axes_mn, axis=0).any()

    @property
    def compared(self) -> tuple[Floats, list[Floats]]:
        """The observed components of the sensor and of each method; no method if they are next to nothing."""
        n = self.observed_axes or 3
        axes, forces = self.axes_mn[:, :n], [force[:, :n] for force in self.forces_mn]
        return axes, forces if np.linalg.norm(axes) > _SIDEWAYS * np.linalg.norm(self.axes_mn) else []


def find_sensor_motion(
    recording: Recording, tracked: TrackedRecording, methods: Mapping[str, Method], sensor: AlignedSensor
) -> SensorMotion | None:
    """Sensor and motion in the tracked frames; None without a sensor, motion or enough frames."""
    moved = next((name for name, one in methods.items() if isinstance(one, FlowSize)), None)
    if sensor.axes_mn is None or moved is None:
        return None
    size = np.array(tracked.force_mn[moved])[:, 0]
    known = np.isfinite(sensor.axes_mn).all(axis=1) & np.isfinite(size) & np.array(tracked.trusted)
    if known.sum() < LEAST_FRAMES or not np.ptp(size[known]) > 0:
        return None
    forces = []
    if recording.meta.young_kpa is not None:
        # A fusion is not an independent estimate.
        alone = [n for n, one in methods.items() if not isinstance(one, (FlowSize, Fusion))]
        every = [np.nan_to_num(tracked.force_mn[name]) for name in alone]
        forces = [force[known] for force in every if force.any()]
    axes = 3 if recording.has_stereo else 2  # one camera does not show motion along the optical axis
    observed = axes if sensor.in_camera_axes else 0
    time_s = np.array(tracked.time_s)[known]
    return SensorMotion(time_s, sensor.axes_mn[known], size[known], tuple(forces), observed)


def check_unit(sensor: SensorMotion) -> list[Finding]:
    """Findings on the unit, by the median ratio to methods that correlate with the sensor."""
    axes, forces = sensor.compared
    gains, size = [], np.linalg.norm(axes, axis=1)
    for force in (np.linalg.norm(one, axis=1) for one in forces):
        pressed = force > _PRESSED * float(np.quantile(force, 0.98))
        if correlation(size, force) > _ALIKE and pressed.any():
            gains.append(float(np.log(max(np.median(size[pressed] / force[pressed]), 1e-9))))
    least = min(map(abs, gains), default=0.0)
    if len(gains) < _METHODS or least < np.log(_ODD_UNIT) or min(gains) < 0 < max(gains):
        return []
    factor, more = np.exp(abs(np.median(gains))), "larger" if gains[0] > 0 else "smaller"
    message = (
        f"the sensor's force is {factor:.2g} times {more} than that of every method: is a unit wrong? "
        "(factor 1000: mN for N, or Pa or MPa for kPa; 102: grams; 100: cm for mm)"
    )
    return [Finding("warning" if least < np.log(_OTHER_UNIT) else "error", "sensor", message)]


def check_axes(sensor: SensorMotion) -> list[Finding]:
    """Findings on a signed permutation of the axes for which the methods' force is along the sensor's."""
    n, (axes, forces) = sensor.observed_axes, sensor.compared
    every = [force / max(float(np.linalg.norm(force)), 1e-12) for force in forces]
    if not every or not n or sensor.is_constant:
        return []
    one = np.sum(every, axis=0)
    both = one.T @ axes / max(float(np.linalg.norm(one) * np.linalg.norm(axes)), 1e-12)
    found = {
        (order, signs): sum(sign * both[k, j] for k, (j, sign) in enumerate(zip(order, signs, strict=True)))
        for order in itertools.permutations(range(n))
        for signs in itertools.product((1, -1), repeat=n)
    }
    best, now = max(found, key=lambda key: found[key]), float(np.trace(both))
    if now > _DISAGREE or found[best] < max(_AGREE, now + _APART):
        return []
    names = ", ".join(f"{'-' * (sign < 0)}f{'xyz'[j]}_n" for j, sign in zip(*best, strict=True))
    message = f"the tissue moves as if the force along the camera's axes were {names} of force.csv"
    if best[1] == (-1,) * n and best[0] == tuple(range(n)):
        message += ": is it the force on the tool (sensor.acts_on)?"
    return [Finding("warning", "sensor", message)]


def check_constant(sensor: SensorMotion) -> list[Finding]:
    """Findings on a force, or a saturated or stuck component, that is constant while the tissue moves."""
    t, moved, size = sensor.time_s, sensor.moved, float(sensor.size_mn[0])
    if sensor.is_constant:
        message = f"force.csv has a constant force of {size:.3g} mN while the tissue moves"
        # A constant 0 is possible in a video without contact.
        return [Finding("error" if size else "warning", "sensor", message)]
    for k, values in enumerate(sensor.axes_mn.T):
        for run in np.split(np.arange(len(values)), np.flatnonzero(np.diff(values)) + 1):
            constant = len(run) > _CONSTANT and values[run[0]] and np.ptp(values)
            if constant and np.ptp(moved[run]) > _MOVES * np.ptp(moved):
                span = f"{t[run[0]]:.3g} to {t[run[-1]]:.3g} s"
                what = f"f{'xyz'[k]}_n is constant at {values[run[0]]:.3g} mN from {span}"
                return [Finding("warning", "sensor", f"{what} while the tissue moves: saturated, or stuck?")]
    return []


def correlation(one: Floats, other: Floats) -> float:
    """Pearson's correlation of two curves (T,); 0 if one is constant."""
    if not (np.ptp(one) > 0 and np.ptp(other) > 0):
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
