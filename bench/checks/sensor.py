"""Checks of the sensor alone: its raw samples, load where there should be none, constant force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from bench.methods.flow_size import FlowSize, flow_sizes
from bench.methods.force_fusion import Fusion
from bench.methods.method_interface import Method
from bench.recording.recording_folder import Recording
from bench.recording.sensor_table import find_bias
from bench.sensor.alignment import AlignedSensor
from bench.sensor.drift import Drift
from bench.sensor.force_sensor import process_force
from bench.tracking.tracking import TrackedRecording
from synth.arrays import Floats, Mask
from synth.errors import UserError
from synth.flow.recording.finding import Finding

_SURGICAL_MN = 5000.0  # force on a brain from which the unit is doubtful; by hand
_MOVED_MM = 0.02  # least mean motion that is not noise of the flow; by hand
_LOADED = 0.25  # share of the range of force above which the tissue is not at rest; by hand
# By hand: step of the motion of tissue at rest over the largest motion; how long it rests after a load [s];
# least time in the rest frame's state that is a rest [s].
_CALM, _RESTS_S, _LEFT_S = 0.06, 0.6, 0.4
_SIGMAS = 4.0  # of noise beyond which a force is no noise
_PARTS, _SAMPLES = 8, 8  # of a span whose medians are compared: most parts, samples of each; by hand
# By hand: rate [Hz] from which a leap of two samples is faster than any touch; least height of a leap, over
# the range of force and over the usual difference from the samples around.
_SPIKE_HZ, _SPIKE, _SPIKE_SIGMAS = 80.0, 0.3, 12.0
_NAMED_SPIKES = 5  # most times that a message lists
LEAST_FRAMES = 8  # for a judgement on the sensor; by hand
_CONSTANT = 3  # frames of constant force that are no saturation
_MOVES = 0.25  # share of the largest motion during constant force, from which it is one


def check_samples(recording: Recording) -> list[Finding]:
    """Findings on the sensor's file: its samples, their unit, and whether spans without contact are given."""
    force = recording.force
    if force is None:
        return [Finding("missing", "sensor", "no force.csv: predictions only, nothing is scored")]
    t, peak_mn = force.time_s, float(np.nanmax(np.linalg.norm(force.force_mn, axis=1)))
    rate = (len(t) - 1) / (t[-1] - t[0])
    findings = [Finding("ok", "sensor", f"{len(t)} samples at {rate:.4g} Hz, up to {peak_mn:.3g} mN")]
    if peak_mn > _SURGICAL_MN and recording.meta.tissue != "phantom":
        message = f"{peak_mn / 1000:.3g} N is a large force for a brain: is force.csv in newtons?"
        findings.append(Finding("warning", "sensor", message))
    spikes_s, height_mn = find_spikes(t, force.force_mn)
    if len(spikes_s):
        times = ", ".join(f"{time:.2f}" for time in spikes_s[:_NAMED_SPIKES])
        message = f"{len(spikes_s)} spikes of up to {height_mn:.3g} mN and one or two samples (at {times}"
        message += ", ... s)" if len(spikes_s) > _NAMED_SPIKES else " s)"
        findings.append(Finding("warning", "sensor", message + ": a loose cable? Leave these samples empty"))
    if not recording.meta.sensor.free_s and (bias := find_bias(force.force_mn)):
        findings.append(Finding("warning", "sensor", bias))
    if not recording.meta.sensor.free_s:
        message = "no sensor.free_s: no tare, no drift correction, no noise floor"
        findings.append(Finding("missing", "sensor", message))
    return findings


def check_free_spans(recording: Recording) -> list[Finding]:
    """Findings on spans without contact: no samples, or a load."""
    force, findings = recording.force, list[Finding]()
    if force is None:
        return findings
    known = np.isfinite(force.force_mn).all(axis=1)
    ends_mn = np.percentile(force.force_mn[known], (0.5, 99.5), axis=0) if known.any() else np.zeros((2, 3))
    range_mn = float(np.linalg.norm(np.ptp(ends_mn, axis=0)))
    for start, stop in recording.meta.sensor.free_s:
        inside = (force.time_s >= start) & (force.time_s <= stop)
        free_mn = force.force_mn[inside & known]
        if not inside.any():
            message = f"sensor.free_s: no samples between {start:g} and {stop:g} s"
            findings.append(Finding("error", "sensor", message))
        elif len(free_mn) > 2:
            change, noise = find_change(free_mn)
            if change > max(_LOADED * range_mn, _SIGMAS * noise):
                message = (
                    f"sensor.free_s: force changes by {change:.3g} mN between {start:g} and {stop:g} s: "
                )
                message += "there is a contact in it; end the span before, or begin it after"
                findings.append(Finding("warning", "sensor", message))
    return findings


def find_spikes(time_s: Floats, force_mn: Floats) -> tuple[Floats, float]:
    """Times (M,) [s] of samples (N, 3) mN that leap away from those around them and back at once, and the
    largest leap [mN]; none of a sensor so slow that a touch may be as short."""
    known = np.isfinite(force_mn).all(axis=1)
    t, force = time_s[known], force_mn[known]
    if len(t) < 2 * _SAMPLES or (len(t) - 1) / np.ptp(t) < _SPIKE_HZ:
        return np.zeros(0), 0.0
    deviation = np.linalg.norm(force - median_filter(force, (5, 1), mode="nearest"), axis=1)
    range_mn = float(np.linalg.norm(np.ptp(np.percentile(force, (2, 98), axis=0), axis=0)))
    leaps = deviation > max(_SPIKE * range_mn, _SPIKE_SIGMAS * 1.4826 * float(np.median(deviation)))
    return t[leaps], float(deviation[leaps].max(initial=0.0))


def find_change(force_mn: Floats) -> tuple[float, float]:
    """The change of a force (N, 3) mN between parts of a span, by their medians, and what noise adds to it.

    The noise is that from sample to sample, whose neighbours are taken for independent.
    """
    parts = np.array_split(force_mn, min(_PARTS, max(len(force_mn) // _SAMPLES, 2)))
    medians = np.array([np.median(part, axis=0) for part in parts])
    steps = np.diff(force_mn, axis=0)
    deviation = 1.4826 * np.median(np.abs(steps - np.median(steps, axis=0)), axis=0) / np.sqrt(2)
    noise = 1.25 * float(np.linalg.norm(deviation)) / np.sqrt(len(parts[-1]))
    return float(np.linalg.norm(np.ptp(medians, axis=0))), noise


def check_rest_frame(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on a load at the rest frame, if the offset of the clocks is stated."""
    force, sync, rest_s = recording.force, recording.meta.sync, tracked.rest_s
    if force is None or rest_s is None or sync.method == "correlate":
        return []
    offset_s = sync.offset_s if sync.method == "offset" else 0.0
    try:
        processed = process_force(force, recording.meta.sensor, offset_s, sync.rate)
    except UserError:  # `check_free_spans` and the scores report it
        return []
    known = np.isfinite(processed.force_mn).all(axis=1)
    if not known.any() or (not recording.meta.sensor.free_s and find_bias(processed.force_mn)):
        return []  # `check_samples` reports the constant part, which is no load
    t, size = processed.time_s[known], np.linalg.norm(processed.force_mn[known], axis=1)
    least_mn, most_mn = float(size.min()), float(size.max())
    rest_mn = float(np.interp(rest_s, t, size))
    step_s = float(np.median(np.diff(t))) if len(t) > 1 else 0.0  # the sensor may start a sample later
    limit = max(_LOADED * (most_mn - least_mn), _SIGMAS * processed.noise_floor_mn)
    if not t[0] - step_s <= rest_s <= t[-1] + step_s or rest_mn - least_mn <= limit:
        return []
    lowest = f"the minimum is {least_mn:.3g} mN at {t[size.argmin()]:.3g} s"
    message = (
        f"the sensor measures {rest_mn:.3g} mN at the rest frame; {lowest}: set rest_frame to a frame there"
    )
    return [Finding("warning", "rest frame", message)]


def check_start(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings, from the video alone, on a rest frame under load if there is no sensor that shows it."""
    motion = next((tracked.force_mn[name] for name in flow_sizes() if name in tracked.force_mn), None)
    known = np.array(tracked.trusted)
    if recording.force is not None or motion is None or known.sum() < LEAST_FRAMES:
        return []
    motion_mm = np.array(motion)[known, 0]
    rest = find_other_rest(np.array(tracked.time_s)[known], motion_mm)
    if rest is None or not motion_mm.max() > _MOVED_MM:
        return []
    message = f"from {rest[0]:.3g} s the tissue rests in another state than the rest frame's: the video "
    message += "starts under load, or a tool holds the tissue at its end"
    return [Finding("warning" if rest[1] else "missing", "rest frame", message)]


def find_other_rest(time_s: Floats, moved: Floats) -> tuple[float, bool] | None:
    """When [s] tissue comes to rest in another state than the rest frame's; whether it never rests in that.

    Tissue that was loaded in the rest frame rests when the load has gone. Under a contact that lasts to the
    end it does so too, but mostly after it has rested in the rest frame. None: it rests there only.
    `moved`: (T,) mean motion since the rest frame, any unit.
    """
    share = moved / max(float(moved.max()), 1e-12)
    calm = np.abs(np.diff(share, prepend=share[0])) < _CALM

    def find_runs(state: Mask) -> list[tuple[float, float]]:
        """Start and duration [s] of each run."""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], state, [False]])))
        return [(time_s[a], time_s[b - 1] - time_s[a]) for a, b in zip(edges[::2], edges[1::2], strict=True)]

    since_s = max(
        (start for start, duration_s in find_runs(calm & (share > 0.5)) if duration_s >= _RESTS_S),
        default=np.inf,
    )
    # A plateau of a contact is left again.
    if not since_s < np.inf or (share[time_s >= since_s] < 0.5).any():
        return None
    return float(since_s), max(
        (duration_s for _, duration_s in find_runs(calm & (share < 0.3))), default=0.0
    ) < _LEFT_S


@dataclass(frozen=True)
class SensorMotion:
    """The sensor's force, the tissue's motion and the methods' forces in the frames that have all of them."""

    time_s: Floats  # (T,) of the tracked frames [s]
    axes_mn: Floats  # (T, 3) the sensor's force
    moved: Floats  # (T,) mean motion of the tissue since the rest frame, any unit
    forces_mn: tuple[Floats, ...] = ()  # of independent methods, (T, 3) in the camera's axes; none without E
    observed_axes: int = 0  # number of camera axes that the video shows; 0 if the sensor has other axes
    leading_mn: Floats | None = None  # (T, 3) of the main method; None without E
    bounds_mn: Floats | None = None  # (T, 2) its interval, NaN where it states none
    rest_mn: Floats | None = None  # (3,) the sensor's force at the rest frame
    noise_mn: float = 0.0  # of the sensor without contact; 0 if unknown
    pulsates: bool = False  # the tissue moves by itself
    may_pulsate: bool = False  # it may, as far as is stated
    calibrated: bool = True  # the interval has the level that it states
    drift: Drift | None = None  # of its zero, against the video; None: unknown, or removed

    @property
    def size_mn(self) -> Floats:
        """(T,) magnitude of the sensor's force."""
        return np.asarray(np.linalg.norm(self.axes_mn, axis=1))

    @property
    def contact_mn(self) -> float:
        """Force at contact: 3 times the noise, at least 5% of the peak."""
        return max(3 * self.noise_mn, 0.05 * float(self.size_mn.max()))

    @property
    def is_constant(self) -> bool:
        """Whether the sensor's force never changes."""
        return not np.ptp(self.axes_mn, axis=0).any()


def find_sensor_motion(
    recording: Recording,
    tracked: TrackedRecording,
    methods: Mapping[str, Method],
    main: str,
    sensor: AlignedSensor,
    scored: Mask,
) -> SensorMotion | None:
    """Sensor and motion in the frames (T,) to be scored; None without a sensor, motion or enough frames."""
    motion_name = next((name for name, method in methods.items() if isinstance(method, FlowSize)), None)
    if sensor.axes_mn is None or motion_name is None:
        return None
    size = np.array(tracked.force_mn[motion_name])[:, 0]
    known = np.isfinite(sensor.axes_mn).all(axis=1) & np.isfinite(size) & np.array(tracked.trusted) & scored
    if known.sum() < LEAST_FRAMES or not np.ptp(size[known]) > 0:
        return None
    forces, leading = [], None
    if recording.meta.young_kpa is not None:
        # A fusion is not an independent estimate.
        independent = [n for n, method in methods.items() if not isinstance(method, (FlowSize, Fusion))]
        method_forces = [np.nan_to_num(tracked.force_mn[name]) for name in independent]
        forces = [force[known] for force in method_forces if force.any()]
        if not isinstance(methods[main], FlowSize):
            leading = np.nan_to_num(tracked.force_mn[main])[known]
    axes = 3 if recording.has_stereo else 2  # one camera does not show motion along the optical axis
    if np.isnan(np.array(tracked.force_mn[main])[known, 1:axes]).any():  # the method states magnitudes only
        axes = 0
    return SensorMotion(
        np.array(tracked.time_s)[known],
        sensor.axes_mn[known],
        size[known],
        tuple(forces),
        axes if sensor.in_camera_axes else 0,
        leading,
        np.array(tracked.bounds[main], np.float64)[known],
        next((force for force in sensor.axes_mn[:2] if np.isfinite(force).all()), None),  # it may start later
        sensor.noise_floor_mn,
        bool(tracked.pulse),
        recording.meta.may_pulsate,
        main not in tracked.uncalibrated,
        sensor.drift,
    )


def check_drift(sensor: SensorMotion) -> list[Finding]:
    """Findings on a zero that drifts: the sensor's force changes between spans with the tissue at rest."""
    drift = sensor.drift
    if drift is None or not drift.is_clear or check_constant(sensor):
        return []
    first_s, last_s = drift.time_s[0], drift.time_s[-1]
    message = (
        f"the sensor's zero drifts by {drift.change_mn:.2g} mN from {first_s:.3g} to {last_s:.3g} s: the "
    )
    message += (
        "video shows the tissue at rest there. Set sensor.drift to remove, or add a span after release to "
    )
    return [Finding("warning", "sensor", message + "sensor.free_s")]


def check_constant(sensor: SensorMotion) -> list[Finding]:
    """Findings on a force, or a saturated or stuck component, that is constant while the tissue moves."""
    t, moved, size = sensor.time_s, sensor.moved, float(sensor.size_mn[0])
    if sensor.is_constant:
        message = f"force.csv has a constant force of {size:.3g} mN while the tissue moves"
        # A constant 0 is possible in a video without contact.
        return [Finding("error" if size else "warning", "sensor", message)]
    for k, values in enumerate(sensor.axes_mn.T):
        for run in np.split(np.arange(len(values)), np.flatnonzero(np.diff(values)) + 1):
            is_constant = len(run) > _CONSTANT and values[run[0]] and np.ptp(values)
            # A held force without noise is constant in all components, and living tissue moves by itself.
            is_noiseless = sensor.noise_mn == 0 and not np.ptp(sensor.axes_mn[run], axis=0).any()
            is_held = sensor.may_pulsate and is_noiseless
            if is_constant and not is_held and np.ptp(moved[run]) > _MOVES * np.ptp(moved):
                span = f"{t[run[0]]:.3g} to {t[run[-1]]:.3g} s"
                fault = f"f{'xyz'[k]}_n is constant at {values[run[0]]:.3g} mN from {span}"
                return [Finding("warning", "sensor", f"{fault} while the tissue moves: saturated, or stuck?")]
    return []
