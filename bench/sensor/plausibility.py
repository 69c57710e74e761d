"""Plausibility of a force sensor's record, given the video: unit, sign, axes, clock and saturation.

No single method is trusted for this: a fault of the sensor is assumed only where all methods contradict it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.recording_flow.finding import Finding

Curve = NDArray[np.float64]


@dataclass(frozen=True)
class Thresholds:
    """Limits of plausible records, set by hand between the corrupted and the clean recordings of
    docs/results/scoring/stability, which reports detections and false alarms."""

    frames: int = 8  # least number
    odd_unit: float = 12.0  # factor between sensor and all methods, in the same direction
    another_unit: float = 50.0  # such a factor from which no force is reported
    methods: int = 2  # least number that must agree on a unit, since one may be wrong itself
    pressed: float = 0.3  # share of the peak from which frames are used for the unit
    alike: float = 0.7  # least correlation with the sensor of methods used for the unit
    sideways: float = 0.2  # least share of the force in the observed axes
    disagree: float = 0.2  # cosine between sensor and methods: largest in the stated axes,
    agree: float = 0.7  # least in the proposed axes,
    apart: float = 0.5  # least difference between the two
    rates: tuple[float, ...] = (0.9, 0.92, 0.95, 0.97, 1.03, 1.05, 1.08, 1.1)  # of a drifting clock
    late_s: float = 1.5  # largest clock error tried, in both directions
    sure: float = 0.96  # correlation of force and motion from which the clock is right
    left: float = 0.3  # share of (1 - correlation) that may remain with the proposed clock
    tried: int = 30  # largest number of lags in each direction, and of positions of a gap
    part: int = 4  # least number of frames before and after a gap
    common: float = 0.6  # least share of the frames that the proposed clock covers
    stands: int = 3  # frames of constant force that are no saturation
    moves: float = 0.25  # share of the largest motion during constant force, from which it is one


LIMITS = Thresholds()


def judge_sensor(
    time_s: Curve, axes_mn: Curve, moved: Curve, forces: Sequence[Curve], observed_axes: int
) -> list[Finding]:
    """Findings on a sensor that contradicts the video.

    Args:
        time_s: (T,) times of the tracked frames [s].
        axes_mn: (T, 3) the sensor's force there; NaN: unknown.
        moved: (T,) mean motion of the tissue since the rest frame, any unit.
        forces: of each method, (T, 3) mN in the camera's axes, NaN: unknown; none if E is unknown.
        observed_axes: number of camera axes that the video shows; 0 if the sensor has other axes.
    """
    known = np.isfinite(axes_mn).all(axis=1) & np.isfinite(moved)
    t, axes, moved = time_s[known], axes_mn[known], moved[known]
    size = np.linalg.norm(axes, axis=1)
    if len(t) < LIMITS.frames or not np.ptp(moved) > 0:
        return []
    if not np.ptp(axes, axis=0).any():
        message = f"force.csv has a constant force of {size[0]:.3g} mN while the tissue moves"
        # A constant 0 is possible in a video without contact.
        return [Finding("bad" if size[0] else "odd", "sensor", message)]
    estimates = [np.nan_to_num(force[known]) for force in forces]
    n = observed_axes or 3
    sideways = np.linalg.norm(axes[:, :n]) > LIMITS.sideways * np.linalg.norm(axes)
    found = _unit(axes[:, :n], [force[:, :n] for force in estimates]) if sideways else []
    found += _axes(axes, estimates, n) if sideways and observed_axes else []
    return [*found, *_clock(t, size, moved), *_stands(t, axes, moved)]


def _unit(axes: Curve, forces: Sequence[Curve]) -> list[Finding]:
    """Tests the unit by the median ratio over pressed frames, of methods that correlate with the sensor."""
    gains, size = [], np.linalg.norm(axes, axis=1)
    for force in (np.linalg.norm(one, axis=1) for one in forces):
        pressed = force > LIMITS.pressed * float(np.quantile(force, 0.98))
        if _correlation(size, force) > LIMITS.alike and pressed.any():
            gains.append(float(np.log(max(np.median(size[pressed] / force[pressed]), 1e-9))))
    least = min(map(abs, gains), default=0.0)
    if len(gains) < LIMITS.methods or least < np.log(LIMITS.odd_unit) or min(gains) < 0 < max(gains):
        return []
    factor, more = np.exp(abs(np.median(gains))), "larger" if gains[0] > 0 else "smaller"
    message = (
        f"the sensor's force is {factor:.2g} times {more} than that of every method: is a unit wrong? "
        "(factor 1000: mN for N, or Pa or MPa for kPa; 102: grams; 100: cm for mm)"
    )
    return [Finding("odd" if least < np.log(LIMITS.another_unit) else "bad", "sensor", message)]


def _axes(axes: Curve, forces: Sequence[Curve], n: int) -> list[Finding]:
    """Finds a signed permutation of the axes for which the methods' force is along the sensor's."""
    every = [force / max(float(np.linalg.norm(force)), 1e-12) for force in forces]
    if not every:
        return []
    one, other = np.sum(every, axis=0)[:, :n], axes[:, :n]
    both = one.T @ other / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-12)
    found = {
        (order, signs): sum(sign * both[k, j] for k, (j, sign) in enumerate(zip(order, signs, strict=True)))
        for order in itertools.permutations(range(n))
        for signs in itertools.product((1, -1), repeat=n)
    }
    best, now = max(found, key=lambda key: found[key]), float(np.trace(both))
    if now > LIMITS.disagree or found[best] < max(LIMITS.agree, now + LIMITS.apart):
        return []
    names = ", ".join(f"{'-' * (sign < 0)}f{'xyz'[j]}_n" for j, sign in zip(*best, strict=True))
    message = f"the tissue moves as if the force along the camera's axes were {names} of force.csv"
    if best[1] == (-1,) * n and best[0] == tuple(range(n)):
        message += ": is it the force on the tool (sensor.acts_on)?"
    return [Finding("odd", "sensor", message)]


def _clock(time_s: Curve, size: Curve, moved: Curve) -> list[Finding]:
    """Finds a clock with a much higher correlation of force and motion."""
    best, found = LIMITS.left, ""
    for what, at in _clocks(time_s) if _correlation(size, moved) < LIMITS.sure else ():
        inside = (at >= time_s[0]) & (at <= time_s[-1])
        if inside.sum() < max(LIMITS.common * len(at), LIMITS.frames):
            continue
        now, other = (_correlation(np.interp(t[inside], time_s, size), moved[inside]) for t in (time_s, at))
        if now < LIMITS.sure and other > LIMITS.agree + LIMITS.disagree and (1 - other) / (1 - now) < best:
            best = (1 - other) / (1 - now)
            found = f"the correlation of force and motion is {now:.2f}, but {other:.2f} if {what}"
    return [Finding("odd", "clocks", found)] if found else []


def _clocks(time_s: Curve) -> Iterator[tuple[str, Curve]]:
    """Possible faults of the clock, and the frames' times (T,) [s] that follow."""
    frame = float(np.median(np.diff(time_s)))
    yield "the video runs backwards", time_s[0] + time_s[-1] - time_s
    for rate in LIMITS.rates:
        what = f"the sensor's clock runs {1 / rate:.2f} times as fast"
        yield what, time_s[0] + (time_s - time_s[0]) * rate
    most = round(LIMITS.late_s / frame)
    for k in range(-most, most + 1, max(1, 2 * most // LIMITS.tried)):
        if k == 0:
            continue
        if abs(k) > 1:  # creep delays the tissue by as much as one frame
            yield f"the sensor's clock is shifted by {k * frame:+.2f} s", time_s - k * frame
            for rate in LIMITS.rates:
                what = f"the sensor's clock is {k * frame:+.2f} s off and runs {1 / rate:.2f} times as fast"
                yield what, time_s[0] + (time_s - time_s[0]) * rate - k * frame
        what = f"{abs(k) * frame:.2f} s of the video are {'missing' if k < 0 else 'repeated'}"
        for start in time_s[LIMITS.part : -LIMITS.part : max(1, len(time_s) // LIMITS.tried)]:
            yield f"{what} at {start:.2f} s", np.where(time_s < start, time_s, time_s - k * frame)


def _stands(time_s: Curve, axes: Curve, moved: Curve) -> list[Finding]:
    """Finds a saturated or stuck component: one that is constant while the tissue moves."""
    for k, values in enumerate(axes.T):
        for run in np.split(np.arange(len(values)), np.flatnonzero(np.diff(values)) + 1):
            stands = len(run) > LIMITS.stands and values[run[0]] and np.ptp(values)
            if stands and np.ptp(moved[run]) > LIMITS.moves * np.ptp(moved):
                span = f"{time_s[run[0]]:.3g} to {time_s[run[-1]]:.3g} s"
                what = f"f{'xyz'[k]}_n is constant at {values[run[0]]:.3g} mN from {span}"
                return [Finding("odd", "sensor", f"{what} while the tissue moves: saturated, or stuck?")]
    return []


def _correlation(one: Curve, other: Curve) -> float:
    if not (np.ptp(one) > 0 and np.ptp(other) > 0):
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
