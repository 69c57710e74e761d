"""Whether a force sensor's record can be that of the film: unit, sign, axes, clock, and whether it measures.

No method is trusted for this; but what all of them contradict alike is the sensor's, or what they share.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from synth.recording_flow.finding import Finding

Curve = NDArray[np.float64]

_ODD_UNIT, _ANOTHER_UNIT = 12.0, 50.0  # factors that all methods are off by, to the same side
_METHODS = 2  # fewer may be what is wrong themselves
_PRESSED, _ALIKE = 0.3, 0.7  # share of a peak, correlation: what a unit is judged by
_SIDEWAYS = 0.2  # of the force must lie in the axes that are seen
_LITTLE, _MUCH, _APART = 0.2, 0.7, 0.5  # cosine of what doesn't agree, of what does, and between them
_LATE_S = 1.5
_SURE, _LESS = 0.96, 0.3  # correlation; share of what it lacks that another clock must leave
_TRIED = 30  # lags either way, and places of a gap, at most
_LEAST_PART = 4  # frames before a gap, and after it
_COMMON = 0.6  # share of the frames that another clock must leave
_STANDS_FRAMES, _MOVES = 3, 0.25  # share of the largest motion
_LEAST_FRAMES = 8


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
    if len(t) < _LEAST_FRAMES or not np.ptp(moved) > 0:
        return []
    if not np.ptp(axes, axis=0).any():
        said = f"force.csv says {size[0]:.3g} mN all the time, while the tissue moves"
        # Nothing is what a film without contact has.
        return [Finding("bad" if size[0] else "odd", "sensor", said)]
    told = [np.nan_to_num(force[known]) for force in forces]
    n = seen_axes or 3
    sideways = np.linalg.norm(axes[:, :n]) > _SIDEWAYS * np.linalg.norm(axes)
    found = _unit(axes[:, :n], [force[:, :n] for force in told]) if sideways else []
    found += _axes(axes, told, n) if sideways and seen_axes else []
    return [*found, *_clock(t, size, moved), *_stands(t, axes, moved)]


def _unit(axes: Curve, forces: Sequence[Curve]) -> list[Finding]:
    """By the median over the frames that are pressed on, of methods that follow the sensor."""
    gains, size = [], np.linalg.norm(axes, axis=1)
    for force in (np.linalg.norm(one, axis=1) for one in forces):
        pressed = force > _PRESSED * float(np.quantile(force, 0.98))
        if _correlation(size, force) > _ALIKE and pressed.any():
            gains.append(float(np.log(max(np.median(size[pressed] / force[pressed]), 1e-9))))
    least = min(map(abs, gains), default=0.0)
    if len(gains) < _METHODS or least < np.log(_ODD_UNIT) or not (min(gains) > 0 or max(gains) < 0):
        return []
    factor, more = np.exp(abs(np.median(gains))), "larger" if gains[0] > 0 else "smaller"
    said = (
        f"the sensor's force is {factor:.2g} times {more} than every method's: a unit is wrong "
        "(mN for N, and Pa or MPa for kPa, make 1000, grams 102, cm for mm 100)"
    )
    return [Finding("odd" if least < np.log(_ANOTHER_UNIT) else "bad", "sensor", said)]


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
    if now > _LITTLE or found[best] < max(_MUCH, now + _APART):
        return []
    names = ", ".join(f"{'-' * (sign < 0)}f{'xyz'[j]}_n" for j, sign in zip(*best, strict=True))
    said = f"the tissue moves as if the force along the camera's axes were {names} of force.csv"
    if best[1] == (-1,) * n and best[0] == tuple(range(n)):
        said += ": is it the force on the tool (sensor.acts_on)?"
    return [Finding("odd", "sensor", said)]


def _clock(time_s: Curve, size: Curve, moved: Curve) -> list[Finding]:
    """Whether force and motion agree much better at another clock, from some frame on, or backwards."""
    best, found = _LESS, ""
    for said, at in _clocks(time_s) if _correlation(size, moved) < _SURE else ():
        inside = (at >= time_s[0]) & (at <= time_s[-1])
        if inside.sum() < max(_COMMON * len(at), _LEAST_FRAMES):
            continue
        now, other = (_correlation(np.interp(t[inside], time_s, size), moved[inside]) for t in (time_s, at))
        if now < _SURE and other > _MUCH + _LITTLE and (1 - other) / (1 - now) < best:
            best = (1 - other) / (1 - now)
            found = f"force and motion correlate by {now:.2f}, but by {other:.2f} if {said}"
    return [Finding("odd", "clocks", found)] if found else []


def _clocks(time_s: Curve) -> Iterator[tuple[str, Curve]]:
    """What may be wrong with a clock, and when its frames (T,) then were [s]."""
    frame = float(np.median(np.diff(time_s)))
    yield "the film runs backwards", time_s[0] + time_s[-1] - time_s
    most = round(_LATE_S / frame)
    for k in range(-most, most + 1, max(1, 2 * most // _TRIED)):
        if k == 0:
            continue
        if abs(k) > 1:  # tissue that creeps is as late
            yield f"the sensor's clock is moved by {k * frame:+.2f} s", time_s - k * frame
        said = f"{abs(k) * frame:.2f} s of the film are {'missing' if k < 0 else 'shown twice'}"
        for start in time_s[_LEAST_PART : -_LEAST_PART : max(1, len(time_s) // _TRIED)]:
            yield f"{said} at {start:.2f} s", np.where(time_s < start, time_s, time_s - k * frame)


def _stands(time_s: Curve, axes: Curve, moved: Curve) -> list[Finding]:
    """Saturated or stuck: a component that keeps one value while the tissue goes on moving."""
    for k, values in enumerate(axes.T):
        for run in np.split(np.arange(len(values)), np.flatnonzero(np.diff(values)) + 1):
            stands = len(run) > _STANDS_FRAMES and values[run[0]] and np.ptp(values)
            if stands and np.ptp(moved[run]) > _MOVES * np.ptp(moved):
                span = f"{time_s[run[0]]:.3g} to {time_s[run[-1]]:.3g} s"
                said = f"f{'xyz'[k]}_n stands at {values[run[0]]:.3g} mN from {span} while the tissue moves"
                return [Finding("odd", "sensor", said + ": saturated, or stuck?")]
    return []


def _correlation(one: Curve, other: Curve) -> float:
    if not (np.ptp(one) > 0 and np.ptp(other) > 0):
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
