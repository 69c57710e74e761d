"""The tissue's own motion: heart and breath move all of it, over and over, with nobody touching it.

Heart and breath are as large as what a gentle contact does, and an inverse takes them for one. What tells
them apart: they are periodic, they move the whole surface, and they go on while there is no contact. So each
rhythm is a motion of the surface (polynomials in the picture's x and y, for what moves all of it is smooth)
times harmonics of one phase, which may run faster and slower; it is fitted on the frames without contact, by
least trimmed squares (Rousseeuw, J. Amer. Stat. Assoc. 79, 1984) where nobody says which these are, and must
foresee frames that it was not fitted on. A rate that wanders by more than a radian or so of phase is lost.

Motion is that of the picture, or in space where there is a second eye: a brain breathes along the view first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Span = tuple[float, float]

_COLUMNS = 20  # cells across the picture
_DEGREE = 4  # of the surface's motion in x and y
_SEEN = 0.3  # share of a cell that must be seen for its motion to count
_RATES_HZ = (0.08, 3.5)
_PERIODS = 3.0  # that the frames without contact must span
_HARMONICS = 3
_LEAST_FRAMES = 30  # without contact; of fewer no rhythm is told
_ORDINARY_HZ = (0.21, 1.5)  # breath under anaesthesia, some 12 a minute, to a quick heart, 90
_MOST_RHYTHMS = 3  # heart, breath, and what is left of either
_MOST_BESIDES = 2  # that move all of the surface, aren't periodic, and would hide what is
_FOLDS = 6
_PREDICTED = 0.3  # share of what moves that the fit must foresee in frames it has not seen
_LEFT = 0.5  # share of what moves without contact that may be left when all is taken off
_LEAST_PX = 0.03  # below what flow can tell, nothing is taken off
_EVEN = 3.0  # 95th percentile of the amplitude over its median; a contact's is larger
_KNOT_S = 4.0
_NOISE_PX = 0.15  # what the rest frame's noise may do to the flow of a cell; more is something that happened


@dataclass
class Surface:
    """How the tissue moved, coarsely: what rhythms are looked for in. Of C components, in any unit."""

    tissue: Flags
    """(h, w)."""
    px: float = 1.0
    """What a pixel is in the motion's unit."""
    weight: tuple[float, ...] = ()
    """(C,) of each component where rhythms are looked for, less for one that is less sure; (): all alike."""
    time_s: list[float] = field(default_factory=list)
    moved: list[NDArray[np.float32]] = field(default_factory=list)
    """(r, c, C) each."""
    seen: list[NDArray[np.float32]] = field(default_factory=list)
    """(r, c) share of each cell that is seen."""

    def add(self, time_s: float, motion: NDArray[np.float32], confidence: NDArray[np.float32]) -> None:
        """One frame that could be followed: (h, w, C) and (h, w) in 0..1."""
        height, width = self.tissue.shape
        size = (_COLUMNS, max(2, round(_COLUMNS * height / width)))
        weight = confidence * self.tissue
        share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
        moved = cv2.resize(motion * weight[..., None], size, interpolation=cv2.INTER_AREA)
        self.time_s.append(time_s)
        self.moved.append(np.asarray(moved / np.maximum(share, 1e-6)[..., None], np.float32))
        self.seen.append(np.asarray(share, np.float32))


@dataclass(frozen=True, eq=False)
class Rhythm:
    """One periodic motion of the whole surface."""

    rate_hz: float
    knots_s: Floats
    """(K,) times of the phase's corrections."""
    knots: Floats
    """(K,) by how much the phase runs ahead of the rate there [rad]."""
    modes: Floats
    """(2 H, B, C): coefficients of cosine and sine of each harmonic."""

    def phase(self, time_s: Floats) -> Floats:
        """(T,) rad at (T,) s."""
        return np.asarray(
            2 * np.pi * self.rate_hz * time_s + np.interp(time_s, self.knots_s, self.knots), np.float64
        )

    def at(self, time_s: Floats) -> Floats:
        """(T, B, C) coefficients of the motion at (T,) s."""
        return np.asarray(
            np.tensordot(_waves(self.phase(time_s), len(self.modes) // 2), self.modes, axes=1), np.float64
        )


@dataclass(frozen=True, eq=False)
class Pulse:
    """All rhythms of one recording, in the components and the unit of the surface they were fitted to."""

    rhythms: tuple[Rhythm, ...]
    basis: NDArray[np.float32]
    """(h, w, B) at the pixels, 0 outside the tissue."""
    offset: Floats
    """(B, C) coefficients of where the rest frame lay, from which motion is measured."""
    still: NDArray[np.float32]
    """(h, w, C) what all frames without contact have in common besides: the rest frame's own noise."""
    amplitudes_px: tuple[float, ...]
    """Of each rhythm: half of the way from one end to the other, median over the tissue [px]."""
    free_share: float
    """Share of the frames that it was fitted on: those taken for free of contact."""

    def at(self, time_s: float) -> NDArray[np.float32]:
        """(h, w, C) by which the surface has moved by itself since the rest frame, or seems to have."""
        now = sum((rhythm.at(np.array([time_s]))[0] for rhythm in self.rhythms), self.offset)
        return np.asarray(self.basis @ now.astype(np.float32) + self.still, np.float32)

    def describe(self, mm_per_px: float) -> str:
        """Amplitudes and rates in words; `mm_per_px`: of the pixels that flow is on."""
        parts = [
            f"{mm_per_px * amplitude:.2g} mm at {rhythm.rate_hz:.3g} Hz"
            for rhythm, amplitude in zip(self.rhythms, self.amplitudes_px, strict=True)
        ]
        return f"the whole surface moves by itself, {' and '.join(parts)}: taken off"


@dataclass(frozen=True, eq=False)
class Search:
    """What was found of the surface's rhythms, and where they were looked for."""

    pulse: Pulse | None
    """None: there is none, or too little shows it."""
    free_s: Floats
    """Times of the frames that could be followed and were taken for free of contact."""
    rates_hz: tuple[float, float] | None
    """Between which rhythms were looked for; None: they weren't."""
    reason: str = ""
    """Why they weren't."""
    besides: tuple[Rhythm, ...] = ()
    """What else moves the whole surface, but isn't periodic enough to be taken off: a drift."""

    def describe(self) -> str:
        """What heart or breath might have been missed, in words; empty if neither was."""
        if self.rates_hz is None:
            return (
                f"heart and breath were not looked for: {self.reason}. "
                "If the tissue moves by itself, that is still in it"
            )
        low, high = self.rates_hz
        if low <= _ORDINARY_HZ[0] and high >= _ORDINARY_HZ[1]:
            return ""
        none = "no heart or breath was found, but " if self.pulse is None else "of heart and breath, "
        return (
            f"{none}only rates from {low:.2g} to {high:.2g} Hz would show in {_told(self.free_s)}. "
            "Slower or faster motion of the tissue's own is still in it"
        )


def _told(free_s: Floats) -> str:
    span = float(np.ptp(free_s)) if len(free_s) else 0.0
    return f"the {len(free_s)} frames over {span:.3g} s that could be followed without contact"


def find_pulse(surface: Surface, rest_s: float, free_s: Sequence[Span] = ()) -> Search:
    """The surface's own rhythms, looked for in the frames without contact.

    Args:
        surface: of the whole recording.
        rest_s: time of the rest frame [s].
        free_s: spans known to be without contact [s]; none: the frames that least depart from smooth and
            periodic motion are taken.
    """
    if len(surface.time_s) < _LEAST_FRAMES:
        return _not_looked_for(np.array(surface.time_s))
    cells = _laid_out(surface)
    time_s, seen, basis = cells.time_s, cells.seen, cells.basis
    if len(basis) < 2 * _terms(_DEGREE):
        return Search(None, time_s, None, "too little of the picture is tissue that could be followed")
    moved = cells.moved * np.array(surface.weight or 1.0) / surface.px
    known = (seen > 0).mean(axis=1) > 0.5
    given = np.zeros(len(time_s), bool)
    for start, stop in free_s:
        given |= (time_s >= start) & (time_s <= stop)
    coefficients = _projected(basis, moved, seen)
    smooth = free = known & (given if free_s else _smooth_frames(basis, coefficients, moved, seen, known))
    rates_hz = _rates(time_s[smooth]) if smooth.sum() >= _LEAST_FRAMES else None
    if rates_hz is None:
        return _not_looked_for(time_s[smooth])
    rhythms: tuple[Rhythm, ...] = ()
    besides: tuple[Rhythm, ...] = ()
    fitted = free
    for _ in range(1 if free_s else 4):
        fitted = free
        rhythms, besides = _rhythms(time_s, coefficients, fitted, basis)
        if not rhythms or free_s:
            break
        whole = (*rhythms, *besides)
        free = known & _explained(time_s, whole, fitted, smooth, basis, coefficients, moved, seen)
        if (free == fitted).all():
            break
    if not rhythms or not _takes_off(time_s, rhythms, besides, smooth, coefficients):
        return Search(None, time_s[smooth], rates_hz)
    pulse = _measured(surface, rhythms, besides, fitted, rest_s, _at_pixels(surface.tissue))
    return Search(pulse, time_s[fitted], rates_hz, besides=besides)


def _not_looked_for(free_s: Floats) -> Search:
    return Search(None, free_s, None, f"{_told(free_s)} are too few")


def carried_over(found: Search, surface: Surface, rest_s: float) -> Pulse:
    """The pulse that was found, as other components of the same frames' motion have it.

    Args:
        found: what came of looking for it; it has a pulse.
        surface: the same frames' motion in other components or another unit.
        rest_s: time of the rest frame [s].
    """
    if found.pulse is None:
        raise AssertionError("there is no pulse to carry over")
    free = np.isin(surface.time_s, found.free_s)
    return _measured(surface, found.pulse.rhythms, found.besides, free, rest_s, found.pulse.basis)


@dataclass(frozen=True)
class _Cells:
    """A surface's cells that are seen in most frames."""

    time_s: Floats
    moved: Floats
    """(T, P, C)."""
    seen: Floats
    """(T, P), 0 where too little is seen to count."""
    used: Flags
    """(r c,) which of all cells they are."""
    basis: Floats
    """(P, B)."""


def _laid_out(surface: Surface) -> _Cells:
    time_s, seen = np.array(surface.time_s), np.stack(surface.seen).astype(np.float64)
    seen = seen.reshape(len(time_s), -1)
    moved = np.stack(surface.moved).reshape(*seen.shape, -1).astype(np.float64)
    used = np.median(seen, axis=0) > _SEEN
    rows = surface.moved[0].shape[0]
    y, x = np.mgrid[:rows, :_COLUMNS] + 0.5
    at = np.column_stack([x.ravel() / _COLUMNS, y.ravel() / rows])[used]
    enough = np.where(seen[:, used] > _SEEN, seen[:, used], 0.0)
    return _Cells(time_s, moved[:, used], enough, used, _polynomials(at))


def _measured(
    surface: Surface,
    rhythms: Sequence[Rhythm],
    besides: Sequence[Rhythm],
    free: Flags,
    rest_s: float,
    basis: NDArray[np.float32],
) -> Pulse:
    """Rhythms of known phase, as the motion of the frames `free` has them, fitted with what moves besides."""
    cells = _laid_out(surface)
    coefficients, t = _projected(cells.basis, cells.moved, cells.seen), cells.time_s[free]
    phases = [(one.rate_hz, one.knots_s, one.knots, len(one.modes) // 2) for one in (*rhythms, *besides)]
    every = _fitted(t, coefficients[free].reshape(len(t), -1), phases, np.eye(coefficients.shape[1]))
    own, others = every[: len(rhythms)], every[len(rhythms) :]
    sizes = tuple(float(np.median(_amplitude(rhythm, cells.basis))) / surface.px for rhythm in own)
    left = coefficients[free] - _sum(own, t) - (_sum(others, t) - _sum(others, np.array([rest_s])))
    offset = _at_rest(t, left, rest_s)
    shape, components = surface.moved[0].shape[:2], coefficients.shape[2]
    common = np.zeros((len(cells.used), components), np.float32)
    common[cells.used] = _in_common(
        cells.basis, coefficients[free], cells.moved[free], cells.seen[free], _NOISE_PX * surface.px
    )
    large = cv2.resize(common.reshape(*shape, components), surface.tissue.shape[::-1])
    still = large * surface.tissue[..., None]
    return Pulse(tuple(own), basis, offset, still, sizes, float(free.mean()))


def _sum(rhythms: Sequence[Rhythm], time_s: Floats) -> Floats:
    """(T, B, C) coefficients of several rhythms together; 0 of none."""
    return np.asarray(sum((one.at(time_s) for one in rhythms), np.zeros(1)), np.float64)


def _in_common(basis: Floats, coefficients: Floats, moved: Floats, seen: Floats, most: float) -> Floats:
    """(P, C) median over frames without contact of what smooth motion leaves, at most `most` in the picture
    and along the view.

    Every flow is measured from the rest frame, so its noise moves the same places in all frames alike.
    """
    left = moved - np.einsum("pa,tac->tpc", basis, coefficients)
    left[seen == 0] = np.nan
    enough = (seen > 0).mean(axis=0) > 0.5
    common = np.zeros(left.shape[1:])
    common[enough] = np.nanmedian(left[:, enough], axis=0)
    for part in (common[:, :2], common[:, 2:]):
        length = np.linalg.norm(part, axis=1, keepdims=True)
        part *= np.minimum(1, most / np.maximum(length, 1e-9))
    return common


def _at_rest(time_s: Floats, left: Floats, rest_s: float) -> Floats:
    """(B, C) what the rhythms leave (T, B, C), at the rest frame: where in its path the tissue lay then.

    From all frames without contact: the phase at one moment alone would be less sure.
    """
    design = np.column_stack([np.ones(len(time_s)), time_s - rest_s])
    constant = np.linalg.lstsq(design, left.reshape(len(left), -1), rcond=None)[0][0]
    return np.asarray(constant.reshape(left.shape[1:]), np.float64)


def _takes_off(
    time_s: Floats, rhythms: Sequence[Rhythm], besides: Sequence[Rhythm], free: Flags, coefficients: Floats
) -> bool:
    """Whether the rhythms explain most of how all smooth frames move, not only those they were fitted on."""
    moving = coefficients[free] - _sum(besides, time_s[free])
    before = float(moving.var(axis=0).sum())
    after = float((moving - _sum(rhythms, time_s[free])).var(axis=0).sum())
    return after < _LEFT * before


def _terms(degree: int) -> int:
    return (degree + 1) * (degree + 2) // 2


def _polynomials(at: Floats) -> Floats:
    """(P, B) products of Legendre polynomials up to `_DEGREE` at places (P, 2) in 0..1."""
    x, y = (np.polynomial.legendre.legvander(2 * axis - 1, _DEGREE) for axis in at.T)
    pairs = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    return np.stack([x[:, i] * y[:, j] for i, j in pairs], axis=1)


def _at_pixels(tissue: Flags) -> NDArray[np.float32]:
    shape = tissue.shape
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    places = np.column_stack([x.ravel() / shape[1], y.ravel() / shape[0]])
    return (_polynomials(places).reshape(*shape, -1) * tissue[..., None]).astype(np.float32)


def _projected(basis: Floats, moved: Floats, seen: Floats) -> Floats:
    """(T, B, C) the polynomials that fit each frame best."""
    gram = np.einsum("tp,pa,pb->tab", seen, basis, basis, optimize=True)
    gram += 1e-3 * np.trace(gram, axis1=1, axis2=2)[:, None, None] / len(gram[0]) * np.eye(len(gram[0]))
    return np.asarray(
        np.linalg.solve(gram, np.einsum("tp,pa,tpc->tac", seen, basis, moved, optimize=True)), np.float64
    )


def _off(basis: Floats, coefficients: Floats, moved: Floats, seen: Floats) -> Floats:
    """(T,) root mean square of what smooth motion leaves [px]."""
    left = np.square(moved - np.einsum("pa,tac->tpc", basis, coefficients)).sum(axis=2)
    return np.asarray(np.sqrt((left * seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1e-9)), np.float64)


def _smooth_frames(basis: Floats, coefficients: Floats, moved: Floats, seen: Floats, known: Flags) -> Flags:
    """(T,) frames whose motion is as smooth as that of the smoothest fifth: a contact's is not."""
    off = _off(basis, coefficients, moved, seen)
    if not known.any():
        return known
    return np.asarray(off <= 2 * np.quantile(off[known], 0.2) + 1e-3, bool)


def _explained(
    time_s: Floats,
    rhythms: Sequence[Rhythm],
    free: Flags,
    smooth: Flags,
    basis: Floats,
    coefficients: Floats,
    moved: Floats,
    seen: Floats,
) -> Flags:
    """(T,) frames that the rhythms leave as little of as of most smooth ones; of most of those they were
    fitted on would let contacts in by and by."""
    own = _sum(rhythms, time_s)
    own = own + (coefficients - own)[free].mean(axis=0)
    off = _off(basis, own, moved, seen)
    return np.asarray(off <= 2.5 * np.median(off[smooth]) + 1e-3, bool)


def _rhythms(
    time_s: Floats, coefficients: Floats, free: Flags, basis: Floats
) -> tuple[tuple[Rhythm, ...], tuple[Rhythm, ...]]:
    """One after the other, the strongest first, each in what those before it leave; and what had to be left
    aside on the way, for it foresees nothing, isn't repeated or isn't everywhere alike."""
    if free.sum() < _LEAST_FRAMES:
        return (), ()
    t = time_s[free]
    # In these coordinates a length is a length of motion over the cells.
    metric = np.linalg.cholesky(basis.T @ basis / len(basis) + 1e-12 * np.eye(basis.shape[1])).T
    y = np.einsum("ab,tbc->tac", metric, coefficients[free]).reshape(len(t), -1)
    back = np.linalg.inv(metric)
    found: list[Candidate] = []
    tried: list[Candidate] = []
    kept: list[bool] = []
    told: list[bool] = []
    while sum(kept) < _MOST_RHYTHMS and len(kept) - sum(kept) <= _MOST_BESIDES:
        rate = _rate(t, y, tried)
        if rate is None:
            break
        tried, periodic = _periodic(t, y, tried, rate)
        if _too_alike(tried):
            break
        size = _amplitude(_fitted(t, y, tried, back)[-1], basis)
        if np.median(size) < _LEAST_PX:
            break
        kept.append(periodic and bool(np.percentile(size, 95) <= _EVEN * np.median(size)))
        # What hid no rhythm is noise, and fitting it would do harm.
        if kept[-1]:
            found, told = tried, list(kept)
    every = _fitted(t, y, found, back)
    own = tuple(one for one, is_own in zip(every, told, strict=True) if is_own)
    return own, tuple(one for one, is_own in zip(every, told, strict=True) if not is_own)


def _periodic(t: Floats, y: Floats, found: Sequence[Candidate], rate: float) -> tuple[list[Candidate], bool]:
    """What was found and one more of that rate, and whether that one is periodic.

    Few frames can't tell three harmonics: it has as many as foresee what they weren't fitted on.
    """
    tried = list(found)
    for count in range(_harmonics(t, rate), 0, -1):
        tried = _refined(t, y, [*found, (rate, *_knots(t, rate), count)])
        if _foresees(t, y, tried):
            return tried, not _runs_away(t, tried[-1])
    return tried, False


def _knots(time_s: Floats, rate_hz: float) -> tuple[Floats, Floats]:
    count = max(2, round(float(np.ptp(time_s)) / max(_KNOT_S, 3 / rate_hz)) + 1)
    return np.linspace(time_s[0], time_s[-1], count), np.zeros(count)


Candidate = tuple[float, Floats, Floats, int]
"""Rate [Hz], the phase's knots (times [s] and corrections [rad]), and how many harmonics."""


def _waves(phase: Floats, harmonics: int) -> Floats:
    """(T, 2 H) cosine and sine of each harmonic."""
    turns = phase[:, None] * np.arange(1, harmonics + 1)
    return np.stack([np.cos(turns), np.sin(turns)], axis=2).reshape(len(phase), -1)


def _harmonics(t: Floats, rate_hz: float) -> int:
    """As many as the frames can tell apart."""
    limit = 0.4 / float(np.median(np.diff(t)))
    return int(np.clip(limit // rate_hz, 1, _HARMONICS))


def _phase(t: Floats, one: Candidate) -> Floats:
    return np.asarray(2 * np.pi * one[0] * t + np.interp(t, one[1], one[2]), np.float64)


def _design(t: Floats, candidates: Sequence[Candidate]) -> Floats:
    """A constant (the rest picture's own noise), a drift, and each rhythm's waves."""
    middle = (t - t.mean()) / max(float(np.ptp(t)), 1e-9)
    parts = [np.ones((len(t), 1)), middle[:, None]]
    parts += [_waves(_phase(t, one), one[3]) for one in candidates]
    return np.concatenate(parts, axis=1)


def _left(design: Floats, y: Floats) -> Floats:
    return y - design @ np.linalg.lstsq(design, y, rcond=None)[0]


def _rates(t: Floats) -> tuple[float, float] | None:
    """Lowest and highest rate that frames at these times can show [Hz]; None: they show none."""
    low = max(_RATES_HZ[0], _PERIODS / max(float(np.ptp(t)), 1e-9))
    high = min(_RATES_HZ[1], 0.45 / float(np.median(np.diff(t))))
    return (low, high) if low < high else None


def _rate(t: Floats, y: Floats, found: Sequence[Candidate]) -> float | None:
    """The rate whose waves explain most of what the rhythms found so far leave (Lomb 1976; Scargle 1982)."""
    rates_hz = _rates(t)
    if rates_hz is None:
        return None
    (low, high), span = rates_hz, float(np.ptp(t))
    # A few components hold what moves together; the rest is noise.
    left = _left(_design(t, found), y)
    u, s, _ = np.linalg.svd(left, full_matrices=False)
    main = u[:, :6] * s[:6]

    known = _design(t, found)

    def lost(rate: float) -> float:
        columns = np.concatenate([known, _waves(2 * np.pi * rate * t, _harmonics(t, rate))], axis=1)
        gram, right = columns.T @ columns, columns.T @ main
        gram += 1e-9 * np.trace(gram) * np.eye(len(gram))
        return -float((right * np.linalg.solve(gram, right)).sum())

    step = 1 / (6 * span)
    rates = np.arange(low, high, step)
    best = float(rates[int(np.argmin([lost(float(rate)) for rate in rates]))])
    # A half or a third of the rate has the same waves among its own: the fastest that does as well is meant.
    for order in (3, 2):
        if order * best < high:
            around = np.linspace(order * best - 2 * step, order * best + 2 * step, 17)
            faster = float(min(around, key=lost))
            if lost(faster) < 0.95 * lost(best):
                best = faster
                break
    return float(minimize_scalar(lost, bounds=(best - step, best + step), method="bounded").x)


def _refined(t: Floats, y: Floats, candidates: Sequence[Candidate]) -> list[Candidate]:
    """The phases let run ahead and behind, where the frames say so: Gauss-Newton, smooth by a prior."""
    now = list(candidates)
    for _ in range(6):
        design = _design(t, now)
        weights = np.linalg.lstsq(design, y, rcond=None)[0]
        left, at = y - design @ weights, 2
        for k, (rate, times, ahead, count) in enumerate(now):
            waves = _waves(_phase(t, now[k]), count).reshape(len(t), count, 2)
            order = np.arange(1, count + 1)[:, None]
            slope = (np.stack([-waves[..., 1], waves[..., 0]], axis=2) * order).reshape(len(t), -1)
            turned = slope @ weights[at : at + 2 * count]
            at += 2 * count
            hats = np.stack([np.interp(t, times, row) for row in np.eye(len(times))], axis=1)
            normal = (hats * np.square(turned).sum(axis=1)[:, None]).T @ hats
            bend = np.diff(np.eye(len(times)), 2, axis=0) if len(times) > 2 else np.zeros((1, len(times)))
            weight = float(np.trace(normal)) / len(times)
            normal += weight * (0.3 * bend.T @ bend + 0.01 * np.eye(len(times)))
            pull = hats.T @ (turned * left).sum(axis=1) - weight * 0.3 * bend.T @ (bend @ ahead)
            now[k] = (rate, times, ahead + np.linalg.solve(normal, pull), count)
    return now


def _foresees(t: Floats, y: Floats, candidates: Sequence[Candidate]) -> bool:
    """Whether the last rhythm, fitted on five sixths of the time, foresees the last sixth, each in turn."""
    fold = np.minimum((np.arange(len(t)) * _FOLDS) // len(t), _FOLDS - 1)
    without = with_it = 0.0
    whole, less = _design(t, candidates), _design(t, candidates[:-1])
    for k in range(_FOLDS):
        out = fold == k
        for design, last in ((less, False), (whole, True)):
            said = design[out] @ np.linalg.lstsq(design[~out], y[~out], rcond=None)[0]
            lost = float(np.square(y[out] - said).sum())
            without, with_it = (without, with_it + lost) if last else (without + lost, with_it)
    return with_it < (1 - _PREDICTED) * without


def _too_alike(candidates: Sequence[Candidate]) -> bool:
    """Whether the last rate is one that was found already, or a harmonic of it."""
    last = candidates[-1][0]
    return any(
        abs(last - order * rate) < 0.03 * last for rate, *_ in candidates[:-1] for order in (0.5, 1, 2, 3)
    )


def _runs_away(t: Floats, one: Candidate) -> bool:
    """Whether its phase, let run behind, made it something too slow to be repeated in so short a time."""
    turns = float(np.ptp(_phase(t, one))) / (2 * np.pi)
    return turns < _PERIODS - 0.5


def _fitted(t: Floats, y: Floats, candidates: Sequence[Candidate], back: Floats) -> list[Rhythm]:
    weights = np.linalg.lstsq(_design(t, candidates), y, rcond=None)[0].reshape(
        -1, len(back), y.shape[1] // len(back)
    )
    weights = np.einsum("ab,kbc->kac", back, weights)
    out, at = [], 2
    for rate, times, ahead, harmonics in candidates:
        out.append(Rhythm(rate, times, ahead, weights[at : at + 2 * harmonics]))
        at += 2 * harmonics
    return out


def _amplitude(rhythm: Rhythm, basis: Floats) -> Floats:
    """(P,) half of the way from one end to the other at each cell [px]."""
    turn = _waves(np.linspace(0, 2 * np.pi, 48, endpoint=False), len(rhythm.modes) // 2)
    path = np.einsum("pa,tac->tpc", basis, np.tensordot(turn, rhythm.modes, axes=1))
    return np.asarray(np.linalg.norm(np.ptp(path, axis=0), axis=1) / 2, np.float64)
