"""Plausibility of a force sensor's record, given the video: unit, sign, axes, clock, and saturation.

No single method is trusted for this; what all of them contradict alike is the sensor's, or what they share.
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
    """When a record is implausible: by hand, between the corrupted and the clean recordings of
    docs/results/scoring/stability, which says what is found and what is wrongly named."""

    frames: int = 8  # at least
    odd_unit: float = 12.0  # factor by which all methods are off, to the same side
    another_unit: float = 50.0  # such a factor that no force may be given
    methods: int = 2  # that a unit needs: a single one may be wrong itself
    pressed: float = 0.3  # share of the peak; of these frames a unit is judged
    alike: float = 0.7  # correlation of a method that may judge a unit
    sideways: float = 0.2  # share of the force that must lie in the observed axes
    disagree: float = 0.2  # cosine of two forces, at most
    agree: float = 0.7  # at least, in other axes
    apart: float = 0.5  # between the two
    late_s: float = 1.5  # of a clock, either way
    sure: float = 0.96  # correlation of force and motion at which no clock is doubted
    left: float = 0.3  # of what correlation lacks to 1, share that another clock may leave
    tried: int = 30  # lags either way, and places of a gap, at most: time
    part: int = 4  # frames before a gap and after it, at least
    common: float = 0.6  # share of the frames that another clock must leave
    stands: int = 3  # frames of one value that are no saturation
    moves: float = 0.25  # share of the largest motion meanwhile that makes them one


LIMITS = Thresholds()


def judge_sensor(
    time_s: Curve, axes_mn: Curve, moved: Curve, forces: Sequence[Curve], seen_axes: int
) -> list[Finding]:
    """What is wrong with a sensor, seen from the film.

    Args:
        time_s: (T,) of the frames that were followed [s].
        axes_mn: (T, 3) the sensor there; NaN where it has nothing.
        moved: (T,) mean motion of the tissue since the rest frame, any unit.
        forces: by each method, (T, 3) mN in the camera's axes, NaN: not known; none where E is unknown.
        seen_axes: how many of them the film shows; 0: the sensor's are others.
    """
    known = np.isfinite(axes_mn).all(axis=1) & np.isfinite(moved)
    t, axes, moved = time_s[known], axes_mn[known], moved[known]
    size = np.linalg.norm(axes, axis=1)
    if len(t) < LIMITS.frames or not np.ptp(moved) > 0:
        return []
    if not np.ptp(axes, axis=0).any():
        said = f"force.csv says {size[0]:.3g} mN all the time, while the tissue moves"
        # Nothing is what a film without contact has.
        return [Finding("bad" if size[0] else "odd", "sensor", said)]
    told = [np.nan_to_num(force[known]) for force in forces]
    n = seen_axes or 3
    sideways = np.linalg.norm(axes[:, :n]) > LIMITS.sideways * np.linalg.norm(axes)
    found = _unit(axes[:, :n], [force[:, :n] for force in told]) if sideways else []
    found += _axes(axes, told, n) if sideways and seen_axes else []
    return [*found, *_clock(t, size, moved), *_stands(t, axes, moved)]


def _unit(axes: Curve, forces: Sequence[Curve]) -> list[Finding]:
    """By the median over the frames that are pressed on, of methods that follow the sensor."""
    gains, size = [], np.linalg.norm(axes, axis=1)
    for force in (np.linalg.norm(one, axis=1) for one in forces):
        pressed = force > LIMITS.pressed * float(np.quantile(force, 0.98))
        if _correlation(size, force) > LIMITS.alike and pressed.any():
            gains.append(float(np.log(max(np.median(size[pressed] / force[pressed]), 1e-9))))
    least = min(map(abs, gains), default=0.0)
    if len(gains) < LIMITS.methods or least < np.log(LIMITS.odd_unit) or min(gains) < 0 < max(gains):
        return []
    factor, more = np.exp(abs(np.median(gains))), "larger" if gains[0] > 0 else "smaller"
    said = (
        f"the sensor's force is {factor:.2g} times {more} than every method's: a unit is wrong "
        "(mN for N, and Pa or MPa for kPa, make 1000, grams 102, cm for mm 100)"
    )
    return [Finding("odd" if least < np.log(LIMITS.another_unit) else "bad", "sensor", said)]


def _axes(axes: Curve, forces: Sequence[Curve], n: int) -> list[Finding]:
    """The signed permutation of the axes at which the methods' force lies along the sensor's."""
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
    said = f"the tissue moves as if the force along the camera's axes were {names} of force.csv"
    if best[1] == (-1,) * n and best[0] == tuple(range(n)):
        said += ": is it the force on the tool (sensor.acts_on)?"
    return [Finding("odd", "sensor", said)]


def _clock(time_s: Curve, size: Curve, moved: Curve) -> list[Finding]:
    """Whether force and motion agree much better at another clock, from some frame on, or backwards."""
    best, found = LIMITS.left, ""
    for said, at in _clocks(time_s) if _correlation(size, moved) < LIMITS.sure else ():
        inside = (at >= time_s[0]) & (at <= time_s[-1])
        if inside.sum() < max(LIMITS.common * len(at), LIMITS.frames):
            continue
        now, other = (_correlation(np.interp(t[inside], time_s, size), moved[inside]) for t in (time_s, at))
        if now < LIMITS.sure and other > LIMITS.agree + LIMITS.disagree and (1 - other) / (1 - now) < best:
            best = (1 - other) / (1 - now)
            found = f"force and motion correlate by {now:.2f}, but by {other:.2f} if {said}"
    return [Finding("odd", "clocks", found)] if found else []


def _clocks(time_s: Curve) -> Iterator[tuple[str, Curve]]:
    """What may be wrong with a clock, and when its frames (T,) then were [s]."""
    frame = float(np.median(np.diff(time_s)))
    yield "the film runs backwards", time_s[0] + time_s[-1] - time_s
    most = round(LIMITS.late_s / frame)
    for k in range(-most, most + 1, max(1, 2 * most // LIMITS.tried)):
        if k == 0:
            continue
        if abs(k) > 1:  # tissue that creeps is as late
            yield f"the sensor's clock is moved by {k * frame:+.2f} s", time_s - k * frame
        said = f"{abs(k) * frame:.2f} s of the film are {'missing' if k < 0 else 'shown twice'}"
        for start in time_s[LIMITS.part : -LIMITS.part : max(1, len(time_s) // LIMITS.tried)]:
            yield f"{said} at {start:.2f} s", np.where(time_s < start, time_s, time_s - k * frame)


def _stands(time_s: Curve, axes: Curve, moved: Curve) -> list[Finding]:
    """Saturated or stuck: a component that keeps one value while the tissue goes on moving."""
    for k, values in enumerate(axes.T):
        for run in np.split(np.arange(len(values)), np.flatnonzero(np.diff(values)) + 1):
            stands = len(run) > LIMITS.stands and values[run[0]] and np.ptp(values)
            if stands and np.ptp(moved[run]) > LIMITS.moves * np.ptp(moved):
                span = f"{time_s[run[0]]:.3g} to {time_s[run[-1]]:.3g} s"
                said = f"f{'xyz'[k]}_n stands at {values[run[0]]:.3g} mN from {span} while the tissue moves"
                return [Finding("odd", "sensor", said + ": saturated, or stuck?")]
    return []


def _correlation(one: Curve, other: Curve) -> float:
    if not (np.ptp(one) > 0 and np.ptp(other) > 0):
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
