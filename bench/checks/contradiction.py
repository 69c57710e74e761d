"""What contradicts the video: the sensor's force against the leading method's, and the causes that fit best.

Each hypothesis on the recording is a transformation of the sensor's force after which it should equal the
estimate up to a gain, which within the stated interval needs no explanation. A residual r has the Laplace
likelihood, which spikes hardly change: n log(mean |r|) over n independent frames, where mean |r| counts from
the noise on; one of N of a kind pays log N. Magnitudes and, if axes are known, components count separately.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import find_peaks
from scipy.special import betainc

from bench.checks.sensor import LEAST_FRAMES, SensorMotion
from learn.uncertainty.intervals import LEVEL
from synth.arrays import Floats, Mask
from synth.flow.recording.finding import Finding

_HELD = 0.6  # coverage of the interval from which it isn't reported; by hand
_CHANCE = 0.05  # largest probability of such a coverage by chance
_SHAPE = 0.05  # mean error of a right estimate's curve over its peak, gain aside
# Mean error of components over the force that axes must leave at most, and that the stated ones must have: a
# right estimate's direction is off by 20 to 45 degrees, exchanged or reversed axes by 60 to 180.
_STRAIGHT, _ASKEW = 0.5, 0.9
_TURNED = 0.4  # mean error of a right estimate's components over its force
_BEYOND = 2.0  # factor between sensor and force that no method errs by; the worst scenes of ours reach 1.7
_SURE = np.log(20.0)  # log odds from which a hypothesis is named
_LIKELY = np.log(3.0)  # the same where the interval fails, so that there is a fault
_ALIKE = np.log(10.0)  # log odds within which others are named next to the best
_LEFT = 0.5  # share of the force's mean deviation that a hypothesis may leave
_SIDEWAYS = 0.2  # least share of the force in the observed axes
_UNITS = {1000.0: "mN for N, or Pa or MPa for kPa", 102.0: "grams", 100.0: "cm for mm"}
_RATES = (0.9, 0.92, 0.95, 0.97, 1.03, 1.05, 1.08, 1.1)
_CAMERAS_HZ = (
    20.0,
    24.0,
    25.0,
    30.0,
    50.0,
    60.0,
)  # a video may be stamped with another rate than it was taken at
_STAMPED = sorted(
    {a / b for a in _CAMERAS_HZ for b in _CAMERAS_HZ if 0.4 <= a / b <= 1.7 and abs(a / b - 1) > 0.11}
)
_RATE_S = 10.0  # least duration for advice on a clock's rate that is nearly right
_RISES = 0.3  # of the largest force, by which it rises and falls with a contact
_LATE_S = 1.5  # largest clock error tried, in both directions
_TRIED = 30  # largest number of lags, and twice that of positions of a gap
_PART = 4  # least number of frames before and after a gap
_UNSENSED = 0.15  # least force over the largest where the sensor measures none
_RATE = 0.08  # least error of a clock's rate
_EDGE_S = 0.1  # error of the time at which a contact begins or ends
_TOP = 95.0  # percentile of a curve that is its height: spikes are above
_COMMON = 0.6  # least share of the frames that a hypothesis covers


@dataclass(frozen=True)
class Hypothesis:
    """A fault of the recording."""

    cause: str
    message: str
    axes_mn: Floats  # (T, 3) what a sensor would measure without it; NaN where unknown
    tried: int = 1  # number of hypotheses of its kind
    any_gain: bool = False  # whether the gain is beyond the stated interval
    turns: bool = False  # whether it exchanges or reverses axes


@dataclass(frozen=True)
class _Judged:
    hypothesis: Hypothesis
    odds: float  # log odds against the recording as it is
    explains: bool  # whether little of the force is left unexplained
    gain: float  # of the sensor


def check_contradiction(sensor: SensorMotion) -> list[Finding]:
    """The finding on a sensor that contradicts the leading method, with the likeliest causes."""
    if sensor.is_constant:
        return []
    findings = _check_hypotheses(sensor)
    if sensor.pulsates or any(finding.cause == "clocks" for finding in findings):
        return findings
    edges = check_edges(sensor)
    return findings + (edges or ([] if findings else check_unsensed(sensor)))


def check_edges(sensor: SensorMotion) -> list[Finding]:
    """The finding on contacts that begin and end at other times in the video than in the sensor's record.

    Tissue follows a load at once, and creep only delays it. So equal errors of begin and end show an offset
    of the clocks, errors that grow with time another rate, an end before that of force missing pictures.
    """
    frame_s = float(np.median(np.diff(sensor.time_s)))
    force, moved = (_edges(sensor.time_s, curve) for curve in (sensor.size_mn, sensor.moved))
    if not len(force) or len(force) != len(moved):
        return []
    late_s, what = moved - force, ""
    offset_s, rate = float(np.median(late_s)), float(np.median(moved / force))
    off_s, apart_s = np.abs(late_s - offset_s).max(), np.abs(moved - rate * force).max()
    lost_s = late_s[::2] - late_s[1::2]  # of each contact
    k = int(np.argmax(lost_s))
    if min(off_s, apart_s) < max(0.5 * frame_s, 0.5 * _EDGE_S):
        if apart_s < off_s and abs(rate - 1) > _RATE and np.abs(late_s).max() > 2 * frame_s:
            times = f"{rate:.3g} times as late in the video as in the sensor's record"
            stamped = f"a clock or the video is stamped with another rate (sync.rate {rate:.3f})"
            what = f"contacts begin and end {times}: {stamped}"
        elif abs(offset_s) > max(1.5 * frame_s, 2 * _EDGE_S):
            when = f"{abs(offset_s):.2f} s {'later' if offset_s > 0 else 'earlier'}"
            add = f"add {offset_s:+.2f} s (sync.offset_s)"
            what = f"contacts begin and end {when} in the video than in the sensor's record: {add}"
    elif lost_s[k] > max(2 * frame_s, 2 * _EDGE_S) and late_s[2 * k] < max(0.5 * frame_s, 0.5 * _EDGE_S):
        what = f"a contact ends {lost_s[k]:.2f} s earlier in the video than in the sensor's record: are "
        what += f"pictures missing between {moved[2 * k]:.2f} and {moved[2 * k + 1]:.2f} s?"
    return [Finding("warning", "clocks", what)] if what else []


def check_unsensed(sensor: SensorMotion) -> list[Finding]:
    """The finding on a force in the video while the sensor measures none."""
    if sensor.bounds_mn is None or sensor.leading_mn is None:
        return []
    # Without spikes, which are no peak.
    top_mn = float(np.percentile(sensor.size_mn, _TOP))
    most_mn = max(top_mn, float(np.linalg.norm(sensor.leading_mn, axis=1).max()))
    contact_mn = 0.05 * top_mn
    at_rest_mn = 0.0 if sensor.rest_mn is None else float(np.linalg.norm(sensor.rest_mn))
    if max(3 * sensor.noise_mn, at_rest_mn) > contact_mn:  # the tare is wrong, or the rest frame is
        return []
    low = np.nan_to_num(sensor.bounds_mn[:, 0])
    alone = (sensor.size_mn < contact_mn) & (low > _UNSENSED * most_mn)
    runs = np.split(np.arange(len(alone)), np.flatnonzero(np.diff(alone)) + 1)
    run = max((run for run in runs if alone[run[0]]), key=len, default=np.zeros(0, int))
    # What isn't released within the video may be the camera's motion.
    if len(run) < 2 or low[run[0] :].min() > _UNSENSED * most_mn:
        return []
    span = f"from {sensor.time_s[run[0]]:.2f} to {sensor.time_s[run[-1]]:.2f} s"
    shown = f"the video shows a force of at least {low[run].max():.2g} mN, but the sensor none"
    what = f"{span} {shown}: is there a contact that it doesn't hold?"
    return [Finding("warning", "sensor", what)]


def _edges(time_s: Floats, curve: Floats) -> Floats:
    """Times (2 n,) [s] at which a curve (T,) rises and falls through half of its range, in turn; none if it
    begins or ends above that, or crosses it for one frame only."""
    level = 0.5 * (float(np.percentile(curve, _TOP)) + float(curve.min()))
    above = (curve > level).astype(int)
    first = np.flatnonzero(np.diff(above))  # the frames before
    if above[0] or above[-1] or not len(first) or np.diff(first).min() < 2:
        return np.zeros(0)
    share = (level - curve[first]) / (curve[first + 1] - curve[first])
    return np.asarray(time_s[first] + share * (time_s[first + 1] - time_s[first]))


def _check_hypotheses(sensor: SensorMotion) -> list[Finding]:
    """The finding on the likeliest causes of a contradiction, if there is one."""
    force, gains = _estimate(sensor)
    judged = sorted(_judge(sensor, force, gains), key=lambda one: -one.odds)
    missed = find_missed(sensor)
    likely = [one for one in judged if one.explains and one.odds > (_LIKELY if missed else _SURE)]
    if missed and not likely:  # by little: what is left is a gain, if the curves are alike
        likely = [one for one in judged if one.explains and one.hypothesis.any_gain]
    if not likely:
        cause = "no cause was found among gain, axes, rest frame and clocks"
        return [Finding("warning", "interval", f"{missed}; {cause}")] if missed else []
    best = likely[0]
    close = [one.hypothesis for one in likely if one.odds > best.odds - _ALIKE]
    names = dict[str, str]()  # the best of each cause
    for one in close:
        names.setdefault(one.message.split(":")[0] if one.turns else one.cause, one.message)
    start = missed or "sensor and video contradict each other"
    # Only what several estimates agree on is certain: one may be wrong itself.
    sure = missed and best.odds > _SURE and all(_agrees(sensor, one, best) for one in sensor.forces_mn)
    sure = sure and (len(sensor.forces_mn) > 1 or _is_shown_by_motion(sensor, best))
    found = f"{start}; most likely {', or '.join(names.values())}"
    return [Finding("error" if sure else "warning", best.hypothesis.cause, found)]


def find_missed(sensor: SensorMotion) -> str:
    """Which frames' interval holds clearly fewer of the sensor's readings than `LEVEL`; empty: none."""
    if sensor.leading_mn is None or sensor.bounds_mn is None:
        return ""
    low, high = sensor.bounds_mn.T
    known = np.isfinite(sensor.bounds_mn).all(axis=1)
    if not known.any():
        return ""
    size, margin = sensor.size_mn, 0.5 * sensor.contact_mn
    held = (size >= low - margin) & (size <= high + margin)
    count = independent(size - np.linalg.norm(sensor.leading_mn, axis=1)) / len(size)
    contact = size > sensor.contact_mn
    parts, few = {"": known, " in contact": known & contact, " without": known & ~contact}, False
    shares = {which: float(held[mask].mean()) for which, mask in parts.items() if mask.any()}
    for which, share in shares.items():
        n = max(2.0, count * parts[which].sum())
        # Binomial probability of at most this share.
        chance = betainc(max(n * (1 - share), 1e-9), n * share + 1, 1 - LEVEL)
        few |= bool(parts[which].sum() >= LEAST_FRAMES and share < _HELD and chance < _CHANCE)
    of = ", ".join(f"{share:.0%}{which}" for which, share in shares.items() if which)
    holds = f"holds {shares['']:.0%} of the sensor's readings ({of})"
    level = f" of {LEVEL:.0%}" if sensor.calibrated else ", not calibrated for this motion,"
    return f"the interval{level} {holds}" if few else ""


def independent(curve: Floats) -> float:
    """Number of independent values of a curve (T,), by its autocorrelation up to the first zero."""
    off = curve - curve.mean()
    full = np.correlate(off, off, "full")[len(off) - 1 :]
    rho = full[1:] / max(float(full[0]), 1e-30)
    ends = np.flatnonzero(rho <= 0)
    return float(len(curve) / (1 + 2 * rho[: ends[0] if len(ends) else None].sum()))


def _estimate(sensor: SensorMotion) -> tuple[Floats, tuple[float, float]]:
    """The video's force (T, 3), and the sensor's gains that its interval allows; without E motion and any."""
    if sensor.leading_mn is None:
        return np.pad(sensor.moved[:, None], ((0, 0), (0, 2))), (0.0, np.inf)
    size = np.linalg.norm(sensor.leading_mn, axis=1)
    low, high = np.full((2, len(size)), np.nan) if sensor.bounds_mn is None else sensor.bounds_mn.T
    pressed = np.isfinite(low + high) & (size > 0.3 * size.max())
    if not pressed.any():
        return sensor.leading_mn, (1 / _BEYOND, _BEYOND)
    with np.errstate(divide="ignore"):
        least, most = (float(np.median(size[pressed] / end[pressed])) for end in (high, low))
    return sensor.leading_mn, (least, most)


def _judge(sensor: SensorMotion, force: Floats, gains: tuple[float, float]) -> Iterator[_Judged]:
    """Every hypothesis against the recording as it is, for an estimate (T, 3) and its range of gains."""
    size = np.linalg.norm(force, axis=1)
    if not np.ptp(size) > 0:
        return
    n = sensor.observed_axes if sensor.leading_mn is not None else 0
    n *= bool(np.linalg.norm(sensor.axes_mn[:, :n]) > _SIDEWAYS * np.linalg.norm(sensor.axes_mn))
    floor = _SHAPE * float(size.max())
    if sensor.leading_mn is not None and sensor.bounds_mn is not None:
        # Uncertainty that does not grow with force, such as that by a pulse.
        wide = (sensor.bounds_mn[:, 1] - size)[np.isfinite(sensor.bounds_mn[:, 1])]
        floor = max(floor, float(np.quantile(wide, 0.1)) if len(wide) else 0.0)

    def misfits(axes: Floats, gain: float, inside: Mask) -> Floats:
        """Mean residual of magnitudes and of components, if they are known."""
        now_mn = gain * axes[inside]
        left, noise = [np.abs(size[inside] - np.linalg.norm(now_mn, axis=1)).mean()], [floor]
        if n:
            left.append(np.linalg.norm(force[inside, :n] - now_mn[:, :n], axis=1).mean())
            noise.append(np.hypot(floor, _TURNED * size[inside].mean()))
        return np.hypot(left, noise)

    now = float(np.clip(_gain(size, sensor.size_mn), *gains))
    count = independent(size - now * sensor.size_mn)
    for one in hypotheses(sensor, n):
        inside: Mask = np.asarray(np.isfinite(one.axes_mn).all(axis=1))
        if inside.sum() < max(_COMMON * len(inside), LEAST_FRAMES):
            continue
        free = _gain(size[inside], np.linalg.norm(one.axes_mn[inside], axis=1))
        gain = free if one.any_gain else float(np.clip(free, *gains))
        before, after = misfits(sensor.axes_mn, now, inside), misfits(one.axes_mn, gain, inside)
        spread = float(np.abs(size[inside] - np.median(size[inside])).mean())
        explains = after[0] < np.hypot(_LEFT * spread, floor)
        if one.turns:
            shares = [
                _direction_error(force[inside, :n], axes[inside, :n])
                for axes in (sensor.axes_mn, one.axes_mn)
            ]
            explains &= shares[0] > _ASKEW and shares[1] < _STRAIGHT
        odds = count * inside.mean() * float(np.log(before / after).sum()) - np.log(one.tried)
        if one.any_gain:
            explains &= not 1 / _BEYOND < free / now < _BEYOND or bool(gains[0] > free or free > gains[1])
            one = _named_gain(one, gain)
        yield _Judged(one, odds, bool(explains), gain)


def _direction_error(force: Floats, sensor_mn: Floats) -> float:
    """Mean error of the observed components (T, n) over the force, gain aside: 0 to 2."""
    sizes = [np.linalg.norm(axes, axis=1) for axes in (force, sensor_mn)]
    gain = sizes[0].sum() / max(float(sizes[1].sum()), 1e-12)
    return float(np.linalg.norm(force - gain * sensor_mn, axis=1).sum() / max(float(sizes[0].sum()), 1e-12))


def _gain(size: Floats, sensor_mn: Floats) -> float:
    """The gain of the sensor (T,) with the least mean residual from forces (T,): a weighted median."""
    used = sensor_mn > 0
    ratio, weight = size[used] / sensor_mn[used], sensor_mn[used]
    order = np.argsort(ratio)
    total = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(total, total[-1] / 2)]) if len(total) else 1.0


def _agrees(sensor: SensorMotion, force: Floats, best: _Judged) -> bool:
    """Whether another method's force (T, 3) has the same cause, beyond what a method errs by."""
    if best.hypothesis.any_gain:
        gain = _gain(np.linalg.norm(force, axis=1), sensor.size_mn)
        return abs(np.log(max(gain, 1e-9))) > np.log(_BEYOND) and (gain > 1) == (best.gain > 1)
    return _has_cause(_judge(sensor, force, (1 / _BEYOND, _BEYOND)), best)


def _is_shown_by_motion(sensor: SensorMotion, best: _Judged) -> bool:
    """Whether the tissue's mean motion, which knows neither gain nor axes, has the same cause."""
    motion = replace(sensor, leading_mn=None)
    return _has_cause(_judge(motion, *_estimate(motion)), best)


def _has_cause(judged: Iterable[_Judged], best: _Judged) -> bool:
    """Whether one of the judged hypotheses of the best one's cause is sure and explains the force."""
    same = (each for each in judged if each.hypothesis.cause == best.hypothesis.cause)
    return any(each.odds > _SURE and each.explains for each in same)


def hypotheses(sensor: SensorMotion, axes: int) -> Iterator[Hypothesis]:
    """Faults of a recording; `axes`: number of axes in which components of force can be compared."""
    t, force = sensor.time_s, sensor.axes_mn
    if sensor.leading_mn is not None:
        yield Hypothesis("force", "", force, len(_UNITS), any_gain=True)
    rest_mn = np.zeros(3) if sensor.rest_mn is None else sensor.rest_mn
    loaded = float(np.linalg.norm(rest_mn))
    if loaded > sensor.contact_mn:
        what = f"the sensor's {loaded:.3g} mN at the rest frame: it shows loaded tissue, or the tare is wrong"
        yield Hypothesis("rest frame", what, force - rest_mn)
    turns = [
        (order, signs)
        for order in itertools.permutations(range(axes))
        for signs in itertools.product((1, -1), repeat=axes)
    ][1:]
    for order, signs in turns:
        names = ", ".join(f"{'-' * (s < 0)}f{'xyz'[j]}_n" for j, s in zip(order, signs, strict=True))
        what = f"axes: the camera's are {names} of force.csv"
        if tool := set(signs) == {-1} and order == tuple(range(axes)):
            what = "the sign: force.csv holds the force on the tool (sensor.acts_on)"
        elif order == tuple(range(axes)) and signs.count(-1) == 1:
            what = f"a mirrored picture: the camera's axes are {names} of force.csv"
        turned = force.copy()
        turned[:, :axes] = force[:, list(order)] * signs
        yield Hypothesis(
            "sensor", what, turned, 1 if tool else len(turns) * (1 + signs.count(-1)), turns=True
        )
    if not sensor.pulsates:
        for what, at, tried in _clocks(sensor):
            outside = (at < t[0]) | (at > t[-1])
            moved = np.stack([np.interp(at, t, axis) for axis in force.T], axis=1)
            yield Hypothesis("clocks", what, np.where(outside[:, None], np.nan, moved), tried)


def _named_gain(one: Hypothesis, gain: float) -> Hypothesis:
    """The hypothesis of a gain with its size in words."""
    factor, more = max(gain, 1 / gain) if gain > 0 else np.inf, "smaller" if gain > 1 else "larger"
    unit = next((name for unit, name in _UNITS.items() if 1 / 1.6 < factor / unit < 1.6), "")
    what = f"a gain: the sensor's force is {factor:.3g} times {more} than the video's"
    what += f" (is a unit wrong? {unit})" if unit else f" (E by this factor, the scale by {factor**0.5:.2g}?)"
    return Hypothesis("sensor" if unit else one.cause, what, one.axes_mn, one.tried, True)


def _clocks(sensor: SensorMotion) -> Iterator[tuple[str, Floats, int]]:
    """Faults of the clock, the frames' times (T,) [s] that follow, and the number of their kind."""
    time_s = sensor.time_s
    frame, since = float(np.median(np.diff(time_s))), time_s - time_s[0]
    yield "the clocks: the video runs backwards", time_s[-1] - since, 1
    most = round(_LATE_S / frame)
    # Creep delays the tissue by as much as one frame.
    lags = [k for k in range(-most, most + 1, max(1, 2 * most // _TRIED)) if abs(k) > 1]
    # Loads that rise and fall twice, whether or not contact is lost between, tell a rate from an offset.
    size = np.pad(sensor.size_mn, 1)
    several = len(find_peaks(size, prominence=_RISES * float(size.max()))[0]) > 1
    rates = (*(_RATES if since[-1] >= _RATE_S else ()), *_STAMPED) if several else ()
    for k in (0, *lags):
        if k:
            yield f"the sensor's clock: add {k * frame:+.2f} s (sync.offset_s)", time_s - k * frame, len(lags)
        for rate in rates:
            late_s = time_s[0] + (k * frame - time_s[0]) / rate
            too = f", sync.offset_s {late_s:+.2f}" if abs(late_s) > frame / 2 else ""
            what = f"the video is stamped with another rate, or a clock is: sync.rate {1 / rate:.4f}{too}"
            yield what, time_s[0] + since * rate - k * frame, len(lags) * len(rates)
    starts = time_s[_PART : -_PART : max(1, 2 * len(time_s) // _TRIED)]
    for k in lags:
        what = f"the clocks: {abs(k) * frame:.2f} s of the video are {'missing' if k < 0 else 'repeated'}"
        for start in starts:
            at = np.where(time_s < start, time_s, time_s - k * frame)
            yield f"{what} at {start:.2f} s", at, len(lags) * len(starts)
