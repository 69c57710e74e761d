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

_LEAST_COVERAGE = 0.6  # coverage of the interval from which it isn't reported; by hand
_CHANCE = 0.05  # largest probability of such a coverage by chance
_SHAPE = 0.05  # mean error of a right estimate's curve over its peak, gain aside
# Mean error of components over the force that axes must leave at most, and that the stated ones must have: a
# right estimate's direction is off by 20 to 45 degrees, exchanged or reversed axes by 60 to 180.
_STRAIGHT, _ASKEW = 0.5, 0.9
_DIRECTION_ERROR = 0.4  # mean error of a right estimate's components over its force
_MAX_GAIN = 2.0  # factor between sensor and force that no method errs by; the worst scenes of ours reach 1.7
_SURE_LOG_ODDS = np.log(20.0)  # log odds from which a hypothesis is named
_LIKELY_LOG_ODDS = np.log(3.0)  # the same where the interval fails, so that there is a fault
_RIVAL_LOG_ODDS = np.log(10.0)  # log odds within which others are named next to the best
_MOST_RESIDUAL = 0.5  # share of the force's mean deviation that a hypothesis may leave
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
class _Verdict:
    hypothesis: Hypothesis
    log_odds: float  # against the recording as it is
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
    force_s, motion_s = (_edges(sensor.time_s, curve) for curve in (sensor.size_mn, sensor.moved))
    if not len(force_s) or len(force_s) != len(motion_s):
        return []
    late_s, message = motion_s - force_s, ""
    offset_s, rate = float(np.median(late_s)), float(np.median(motion_s / force_s))
    offset_error_s, rate_error_s = np.abs(late_s - offset_s).max(), np.abs(motion_s - rate * force_s).max()
    lost_s = late_s[::2] - late_s[1::2]  # of each contact
    k = int(np.argmax(lost_s))
    if min(offset_error_s, rate_error_s) < max(0.5 * frame_s, 0.5 * _EDGE_S):
        if rate_error_s < offset_error_s and abs(rate - 1) > _RATE and np.abs(late_s).max() > 2 * frame_s:
            ratio = f"{rate:.3g} times as late in the video as in the sensor's record"
            cause = f"a clock or the video is stamped with another rate (sync.rate {rate:.3f})"
            message = f"contacts begin and end {ratio}: {cause}"
        elif abs(offset_s) > max(1.5 * frame_s, 2 * _EDGE_S):
            delay = f"{abs(offset_s):.2f} s {'later' if offset_s > 0 else 'earlier'}"
            cure = f"add {offset_s:+.2f} s (sync.offset_s)"
            message = f"contacts begin and end {delay} in the video than in the sensor's record: {cure}"
    elif lost_s[k] > max(2 * frame_s, 2 * _EDGE_S) and late_s[2 * k] < max(0.5 * frame_s, 0.5 * _EDGE_S):
        message = f"a contact ends {lost_s[k]:.2f} s earlier in the video than in the sensor's record: are "
        message += f"pictures missing between {motion_s[2 * k]:.2f} and {motion_s[2 * k + 1]:.2f} s?"
    return [Finding("warning", "clocks", message)] if message else []


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
    is_unsensed = (sensor.size_mn < contact_mn) & (low > _UNSENSED * most_mn)
    runs = np.split(np.arange(len(is_unsensed)), np.flatnonzero(np.diff(is_unsensed)) + 1)
    run = max((run for run in runs if is_unsensed[run[0]]), key=len, default=np.zeros(0, int))
    # What isn't released within the video may be the camera's motion.
    if len(run) < 2 or low[run[0] :].min() > _UNSENSED * most_mn:
        return []
    span = f"from {sensor.time_s[run[0]]:.2f} to {sensor.time_s[run[-1]]:.2f} s"
    observation = f"the video shows a force of at least {low[run].max():.2g} mN, but the sensor none"
    message = f"{span} {observation}: is there a contact that it doesn't hold?"
    return [Finding("warning", "sensor", message)]


def _edges(time_s: Floats, curve: Floats) -> Floats:
    """Times (2 n,) [s] at which a curve (T,) rises and falls through half of its range, in turn; none if it
    begins or ends above that, or crosses it for one frame only."""
    level = 0.5 * (float(np.percentile(curve, _TOP)) + float(curve.min()))
    is_above = (curve > level).astype(int)
    crossings = np.flatnonzero(np.diff(is_above))  # the frames before
    if is_above[0] or is_above[-1] or not len(crossings) or np.diff(crossings).min() < 2:
        return np.zeros(0)
    share = (level - curve[crossings]) / (curve[crossings + 1] - curve[crossings])
    return np.asarray(time_s[crossings] + share * (time_s[crossings + 1] - time_s[crossings]))


def _check_hypotheses(sensor: SensorMotion) -> list[Finding]:
    """The finding on the likeliest causes of a contradiction, if there is one."""
    force, gains = _estimate(sensor)
    verdicts = sorted(_judge(sensor, force, gains), key=lambda verdict: -verdict.log_odds)
    shortfall = find_missed(sensor)
    least_log_odds = _LIKELY_LOG_ODDS if shortfall else _SURE_LOG_ODDS
    candidates = [verdict for verdict in verdicts if verdict.explains and verdict.log_odds > least_log_odds]
    if shortfall and not candidates:  # by little: what is left is a gain, if the curves are alike
        candidates = [verdict for verdict in verdicts if verdict.explains and verdict.hypothesis.any_gain]
    if not candidates:
        cause = "no cause was found among gain, axes, rest frame and clocks"
        return [Finding("warning", "interval", f"{shortfall}; {cause}")] if shortfall else []
    best = candidates[0]
    rivals = [
        verdict.hypothesis for verdict in candidates if verdict.log_odds > best.log_odds - _RIVAL_LOG_ODDS
    ]
    messages = dict[str, str]()  # the best of each cause
    for hypothesis in rivals:
        cause = hypothesis.message.split(":")[0] if hypothesis.turns else hypothesis.cause
        messages.setdefault(cause, hypothesis.message)
    subject = shortfall or "sensor and video contradict each other"
    # Only what several estimates agree on is certain: one may be wrong itself.
    is_certain = (
        shortfall
        and best.log_odds > _SURE_LOG_ODDS
        and all(_agrees(sensor, force_mn, best) for force_mn in sensor.forces_mn)
    )
    is_certain = is_certain and (len(sensor.forces_mn) > 1 or _is_shown_by_motion(sensor, best))
    message = f"{subject}; most likely {', or '.join(messages.values())}"
    return [Finding("error" if is_certain else "warning", best.hypothesis.cause, message)]


def find_missed(sensor: SensorMotion) -> str:
    """Which frames' interval holds clearly fewer of the sensor's readings than `LEVEL`; empty: none."""
    if sensor.leading_mn is None or sensor.bounds_mn is None:
        return ""
    low, high = sensor.bounds_mn.T
    known = np.isfinite(sensor.bounds_mn).all(axis=1)
    if not known.any():
        return ""
    size, margin = sensor.size_mn, 0.5 * sensor.contact_mn
    is_covered = (size >= low - margin) & (size <= high + margin)
    count = count_independent(size - np.linalg.norm(sensor.leading_mn, axis=1)) / len(size)
    contact = size > sensor.contact_mn
    parts, is_low = {"": known, " in contact": known & contact, " without": known & ~contact}, False
    shares = {which: float(is_covered[mask].mean()) for which, mask in parts.items() if mask.any()}
    for which, share in shares.items():
        n = max(2.0, count * parts[which].sum())
        # Binomial probability of at most this share.
        chance = betainc(max(n * (1 - share), 1e-9), n * share + 1, 1 - LEVEL)
        is_low |= bool(parts[which].sum() >= LEAST_FRAMES and share < _LEAST_COVERAGE and chance < _CHANCE)
    by_part = ", ".join(f"{share:.0%}{which}" for which, share in shares.items() if which)
    coverage = f"holds {shares['']:.0%} of the sensor's readings ({by_part})"
    level = f" of {LEVEL:.0%}" if sensor.calibrated else ", not calibrated for this motion,"
    return f"the interval{level} {coverage}" if is_low else ""


def count_independent(curve: Floats) -> float:
    """Number of independent values of a curve (T,), by its autocorrelation up to the first zero."""
    deviation = curve - curve.mean()
    covariance = np.correlate(deviation, deviation, "full")[len(deviation) - 1 :]
    rho = covariance[1:] / max(float(covariance[0]), 1e-30)
    zeros = np.flatnonzero(rho <= 0)
    return float(len(curve) / (1 + 2 * rho[: zeros[0] if len(zeros) else None].sum()))


def _estimate(sensor: SensorMotion) -> tuple[Floats, tuple[float, float]]:
    """The video's force (T, 3), and the sensor's gains that its interval allows; without E motion and any."""
    if sensor.leading_mn is None:
        return np.pad(sensor.moved[:, None], ((0, 0), (0, 2))), (0.0, np.inf)
    size = np.linalg.norm(sensor.leading_mn, axis=1)
    low, high = np.full((2, len(size)), np.nan) if sensor.bounds_mn is None else sensor.bounds_mn.T
    is_pressed = np.isfinite(low + high) & (size > 0.3 * size.max())
    if not is_pressed.any():
        return sensor.leading_mn, (1 / _MAX_GAIN, _MAX_GAIN)
    with np.errstate(divide="ignore"):
        low_gain, high_gain = (float(np.median(size[is_pressed] / end[is_pressed])) for end in (high, low))
    return sensor.leading_mn, (low_gain, high_gain)


def _judge(sensor: SensorMotion, force: Floats, gains: tuple[float, float]) -> Iterator[_Verdict]:
    """Every hypothesis against the recording as it is, for an estimate (T, 3) and its range of gains."""
    size = np.linalg.norm(force, axis=1)
    if not np.ptp(size) > 0:
        return
    n = sensor.observed_axes if sensor.leading_mn is not None else 0
    n *= bool(np.linalg.norm(sensor.axes_mn[:, :n]) > _SIDEWAYS * np.linalg.norm(sensor.axes_mn))
    floor = _SHAPE * float(size.max())
    if sensor.leading_mn is not None and sensor.bounds_mn is not None:
        # Uncertainty that does not grow with force, such as that by a pulse.
        margins = (sensor.bounds_mn[:, 1] - size)[np.isfinite(sensor.bounds_mn[:, 1])]
        floor = max(floor, float(np.quantile(margins, 0.1)) if len(margins) else 0.0)

    def measure(axes: Floats, gain: float, inside: Mask) -> Floats:
        """Mean residual of magnitudes and of components, if they are known."""
        scaled_mn = gain * axes[inside]
        residuals, noise = [np.abs(size[inside] - np.linalg.norm(scaled_mn, axis=1)).mean()], [floor]
        if n:
            residuals.append(np.linalg.norm(force[inside, :n] - scaled_mn[:, :n], axis=1).mean())
            noise.append(np.hypot(floor, _DIRECTION_ERROR * size[inside].mean()))
        return np.hypot(residuals, noise)

    base_gain = float(np.clip(_gain(size, sensor.size_mn), *gains))
    count = count_independent(size - base_gain * sensor.size_mn)
    for hypothesis in hypotheses(sensor, n):
        inside: Mask = np.asarray(np.isfinite(hypothesis.axes_mn).all(axis=1))
        if inside.sum() < max(_COMMON * len(inside), LEAST_FRAMES):
            continue
        free_gain = _gain(size[inside], np.linalg.norm(hypothesis.axes_mn[inside], axis=1))
        gain = free_gain if hypothesis.any_gain else float(np.clip(free_gain, *gains))
        before, after = measure(sensor.axes_mn, base_gain, inside), measure(hypothesis.axes_mn, gain, inside)
        spread = float(np.abs(size[inside] - np.median(size[inside])).mean())
        explains = after[0] < np.hypot(_MOST_RESIDUAL * spread, floor)
        if hypothesis.turns:
            shares = [
                _direction_error(force[inside, :n], axes[inside, :n])
                for axes in (sensor.axes_mn, hypothesis.axes_mn)
            ]
            explains &= shares[0] > _ASKEW and shares[1] < _STRAIGHT
        log_odds = count * inside.mean() * float(np.log(before / after).sum()) - np.log(hypothesis.tried)
        if hypothesis.any_gain:
            explains &= not 1 / _MAX_GAIN < free_gain / base_gain < _MAX_GAIN or bool(
                gains[0] > free_gain or free_gain > gains[1]
            )
            hypothesis = _name_gain(hypothesis, gain)
        yield _Verdict(hypothesis, log_odds, bool(explains), gain)


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


def _agrees(sensor: SensorMotion, force: Floats, best: _Verdict) -> bool:
    """Whether another method's force (T, 3) has the same cause, beyond what a method errs by."""
    if best.hypothesis.any_gain:
        gain = _gain(np.linalg.norm(force, axis=1), sensor.size_mn)
        return abs(np.log(max(gain, 1e-9))) > np.log(_MAX_GAIN) and (gain > 1) == (best.gain > 1)
    return _has_cause(_judge(sensor, force, (1 / _MAX_GAIN, _MAX_GAIN)), best)


def _is_shown_by_motion(sensor: SensorMotion, best: _Verdict) -> bool:
    """Whether the tissue's mean motion, which knows neither gain nor axes, has the same cause."""
    motion = replace(sensor, leading_mn=None)
    return _has_cause(_judge(motion, *_estimate(motion)), best)


def _has_cause(verdicts: Iterable[_Verdict], best: _Verdict) -> bool:
    """Whether one of the judged hypotheses of the best one's cause is sure and explains the force."""
    rivals = (verdict for verdict in verdicts if verdict.hypothesis.cause == best.hypothesis.cause)
    return any(verdict.log_odds > _SURE_LOG_ODDS and verdict.explains for verdict in rivals)


def hypotheses(sensor: SensorMotion, axes: int) -> Iterator[Hypothesis]:
    """Faults of a recording; `axes`: number of axes in which components of force can be compared."""
    t, force = sensor.time_s, sensor.axes_mn
    if sensor.leading_mn is not None:
        yield Hypothesis("force", "", force, len(_UNITS), any_gain=True)
    rest_mn = np.zeros(3) if sensor.rest_mn is None else sensor.rest_mn
    load_mn = float(np.linalg.norm(rest_mn))
    if load_mn > sensor.contact_mn:
        message = (
            f"the sensor's {load_mn:.3g} mN at the rest frame: it shows loaded tissue, or the tare is wrong"
        )
        yield Hypothesis("rest frame", message, force - rest_mn)
    axis_maps = [
        (order, signs)
        for order in itertools.permutations(range(axes))
        for signs in itertools.product((1, -1), repeat=axes)
    ][1:]
    for order, signs in axis_maps:
        names = ", ".join(f"{'-' * (s < 0)}f{'xyz'[j]}_n" for j, s in zip(order, signs, strict=True))
        message = f"axes: the camera's are {names} of force.csv"
        if is_reversed := set(signs) == {-1} and order == tuple(range(axes)):
            message = "the sign: force.csv holds the force on the tool (sensor.acts_on)"
        elif order == tuple(range(axes)) and signs.count(-1) == 1:
            message = f"a mirrored picture: the camera's axes are {names} of force.csv"
        mapped_mn = force.copy()
        mapped_mn[:, :axes] = force[:, list(order)] * signs
        yield Hypothesis(
            "sensor",
            message,
            mapped_mn,
            1 if is_reversed else len(axis_maps) * (1 + signs.count(-1)),
            turns=True,
        )
    if not sensor.pulsates:
        for message, shifted_s, count in _clocks(sensor):
            is_outside = (shifted_s < t[0]) | (shifted_s > t[-1])
            shifted_mn = np.stack([np.interp(shifted_s, t, axis) for axis in force.T], axis=1)
            yield Hypothesis("clocks", message, np.where(is_outside[:, None], np.nan, shifted_mn), count)


def _name_gain(hypothesis: Hypothesis, gain: float) -> Hypothesis:
    """The hypothesis of a gain with its size in words."""
    factor, comparative = max(gain, 1 / gain) if gain > 0 else np.inf, "smaller" if gain > 1 else "larger"
    unit = next((name for unit, name in _UNITS.items() if 1 / 1.6 < factor / unit < 1.6), "")
    message = f"a gain: the sensor's force is {factor:.3g} times {comparative} than the video's"
    message += (
        f" (is a unit wrong? {unit})" if unit else f" (E by this factor, the scale by {factor**0.5:.2g}?)"
    )
    return Hypothesis(
        "sensor" if unit else hypothesis.cause, message, hypothesis.axes_mn, hypothesis.tried, True
    )


def _clocks(sensor: SensorMotion) -> Iterator[tuple[str, Floats, int]]:
    """Faults of the clock, the frames' times (T,) [s] that follow, and the number of their kind."""
    time_s = sensor.time_s
    frame_s, elapsed_s = float(np.median(np.diff(time_s))), time_s - time_s[0]
    yield "the clocks: the video runs backwards", time_s[-1] - elapsed_s, 1
    max_lag = round(_LATE_S / frame_s)
    # Creep delays the tissue by as much as one frame.
    lags = [k for k in range(-max_lag, max_lag + 1, max(1, 2 * max_lag // _TRIED)) if abs(k) > 1]
    # Loads that rise and fall twice, whether or not contact is lost between, tell a rate from an offset.
    size = np.pad(sensor.size_mn, 1)
    has_several_peaks = len(find_peaks(size, prominence=_RISES * float(size.max()))[0]) > 1
    rates = (*(_RATES if elapsed_s[-1] >= _RATE_S else ()), *_STAMPED) if has_several_peaks else ()
    for k in (0, *lags):
        if k:
            yield (
                f"the sensor's clock: add {k * frame_s:+.2f} s (sync.offset_s)",
                time_s - k * frame_s,
                len(lags),
            )
        for rate in rates:
            late_s = time_s[0] + (k * frame_s - time_s[0]) / rate
            offset = f", sync.offset_s {late_s:+.2f}" if abs(late_s) > frame_s / 2 else ""
            message = (
                f"the video is stamped with another rate, or a clock is: sync.rate {1 / rate:.4f}{offset}"
            )
            yield message, time_s[0] + elapsed_s * rate - k * frame_s, len(lags) * len(rates)
    starts = time_s[_PART : -_PART : max(1, 2 * len(time_s) // _TRIED)]
    for k in lags:
        message = (
            f"the clocks: {abs(k) * frame_s:.2f} s of the video are {'missing' if k < 0 else 'repeated'}"
        )
        for start in starts:
            shifted_s = np.where(time_s < start, time_s, time_s - k * frame_s)
            yield f"{message} at {start:.2f} s", shifted_s, len(lags) * len(starts)
