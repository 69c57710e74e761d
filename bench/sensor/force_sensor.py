"""Processing of the sensor's raw samples into the force on the tissue at the frames' times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from bench.recording.meta import SensorMeta
from bench.recording.recording_folder import Force
from synth.arrays import Floats
from synth.errors import UserError

STANDARD_GRAVITY = 9.80665  # m/s² = mN/g

_GAP = 5.0  # sample intervals from which there is a gap
_ACROSS = 32  # samples over which the sample interval is averaged
_ORDER = 4
_NO_UNIT = 0.1  # largest deviation from 1 of the length of gravity's direction


@dataclass(frozen=True)
class ProcessedForce:
    """Force on the tissue, on the video's clock."""

    time_s: Floats  # (N,) rising [s]
    force_mn: Floats  # (N, 3) mN; NaN in gaps
    noise_floor_mn: float  # filtered standard deviation without contact, all components; 0: unknown
    steps: tuple[str, ...]  # of the processing, in order, in words


def process_force(force: Force, sensor: SensorMeta, offset_s: float, rate: float = 1.0) -> ProcessedForce:
    """Removes gravity, tare and drift, filters, multiplies the clock by `rate` and adds `offset_s`.

    UserError for a contact-free span without samples, or a mass without a unit vector of gravity.
    """
    steps: list[str] = []
    values = _remove_weight(force, sensor, steps)
    if sensor.to_camera is not None:
        values = values @ np.array(sensor.to_camera).T
        steps.append("rotated to the camera's axes")
    values = _remove_tare(force.time_s, values, sensor, steps)
    values = _smooth(force.time_s, values, sensor.low_pass_hz, steps)
    floor = _floor(force.time_s, values, sensor)
    if rate != 1:
        steps.append(f"clock multiplied by {rate:.6g}")
    if offset_s:
        steps.append(f"clock shifted by {offset_s * 1000:+.1f} ms")
    return ProcessedForce(rate * force.time_s + offset_s, values, floor, tuple(steps))


def interpolate_force(processed: ProcessedForce, time_s: Floats) -> Floats:
    """Force at the given times by linear interpolation, (T, 3) mN; NaN in gaps and outside the samples."""
    t, values = processed.time_s, processed.force_mn
    force_mn = np.stack(
        [np.interp(time_s, t, column, left=np.nan, right=np.nan) for column in values.T], axis=1
    )
    step = _step(t)
    upper = np.clip(np.searchsorted(t, time_s), 1, len(t) - 1)
    in_gap = (t[upper] - t[upper - 1] > _GAP * step) & (time_s != t[upper]) & (time_s != t[upper - 1])
    force_mn[in_gap] = np.nan
    return force_mn


def _remove_weight(force: Force, sensor: SensorMeta, steps: list[str]) -> Floats:
    if sensor.mass_g == 0:
        return force.force_mn.copy()
    if force.gravity is None:
        raise UserError("sensor.mass_g requires columns gx, gy, gz, the direction of gravity, in force.csv")
    length = np.linalg.norm(force.gravity, axis=1)
    deviation = np.abs(length - 1)
    if np.nanmax(deviation, initial=0.0) > _NO_UNIT:
        raise UserError(
            f"force.csv: gx, gy, gz have the length {length[np.nanargmax(deviation)]:.4g} at "
            f"{force.time_s[np.nanargmax(deviation)]:.6g} s; give a unit vector along gravity, not m/s²"
        )
    sign = -1.0 if sensor.acts_on == "tool" else 1.0  # the file's sign was reversed on reading
    steps.append(f"weight of {sensor.mass_g:g} g removed")
    return np.asarray(force.force_mn - sign * sensor.mass_g * STANDARD_GRAVITY * force.gravity, np.float64)


def _remove_tare(time_s: Floats, values: Floats, sensor: SensorMeta, steps: list[str]) -> Floats:
    """Subtracts tare and drift: interpolated medians of the contact-free spans, constant beyond them."""
    if not sensor.free_s:
        return values
    medians = []
    for start, stop in sensor.free_s:
        inside = (time_s >= start) & (time_s <= stop) & np.isfinite(values).all(axis=1)
        if not inside.any():
            raise UserError(f"sensor.free_s: no samples between {start:g} and {stop:g} s")
        medians.append((float(time_s[inside].mean()), *np.median(values[inside], axis=0)))
    # Sorted by their middles, because spans may overlap.
    middles, *zeros = np.array(sorted(medians)).T
    zero = np.stack([np.interp(time_s, middles, column) for column in zeros], axis=1)
    drift = float(np.linalg.norm(zero - zero[0], axis=1).max())
    word = "tare" if len(middles) == 1 else f"tare and drift ({drift:.1f} mN)"
    steps.append(f"{word} from {len(middles)} contact-free span{'s' * (len(middles) > 1)}")
    return np.asarray(values - zero, np.float64)


def _smooth(time_s: Floats, values: Floats, cutoff_hz: float | None, steps: list[str]) -> Floats:
    """Butterworth filter of each run of samples without gaps, resampled to uniform times and back."""
    if cutoff_hz is None:
        return values
    step = _step(time_s)
    if cutoff_hz >= 0.4 / step:
        steps.append(
            f"no low-pass: {cutoff_hz:g} Hz is too close to half the sensor's rate, {1 / step:.4g} Hz"
        )
        return values
    sos = signal.butter(_ORDER, cutoff_hz, fs=1 / step, output="sos")
    smoothed = np.full_like(values, np.nan)
    indices, short_runs = np.flatnonzero(np.isfinite(values).all(axis=1)), list[int]()
    starts = np.flatnonzero(np.diff(time_s[indices]) > _GAP * step) + 1
    for run in np.split(indices, starts) if len(indices) else ():
        t = time_s[run]
        even_s = np.arange(t[0], t[-1] + step / 2, step)
        if len(even_s) <= 3 * (2 * len(sos) + 1):
            smoothed[run] = values[run]
            short_runs.append(len(run))
            continue
        for k in range(values.shape[1]):
            x = np.interp(even_s, t, values[run, k])
            smoothed[run, k] = np.interp(t, even_s, signal.sosfiltfilt(sos, x))
    steps.append(f"zero-phase Butterworth low-pass, order {_ORDER}, {cutoff_hz:g} Hz")
    if short_runs:
        steps.append(f"not filtered: {sum(short_runs)} samples in {len(short_runs)} runs that are too short")
    return smoothed


def _step(time_s: Floats) -> float:
    """Sample interval [s]: the median, for gaps, of means over dozens of samples, for stamps in bursts."""
    across = min(_ACROSS, max(len(time_s) // 4, 1))
    return float(np.median(time_s[across:] - time_s[:-across])) / across


def _floor(time_s: Floats, values: Floats, sensor: SensorMeta) -> float:
    spreads = []
    for start, stop in sensor.free_s:
        inside = values[(time_s >= start) & (time_s <= stop)]
        inside = inside[np.isfinite(inside).all(axis=1)]
        if len(inside) > 2:
            spreads.append(float(inside.var(axis=0).sum()))
    return float(np.sqrt(np.mean(spreads))) if spreads else 0.0
