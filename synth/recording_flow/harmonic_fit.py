"""Rhythms fitted to the coefficients of a smooth motion: harmonics of phases whose rate may wander."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

Floats = NDArray[np.float64]
Span = tuple[float, float]


@dataclass(frozen=True)
class RhythmConstants:
    """What a rhythm is: by hand, on the videos of tests/synth/recording_flow/test_pulse.py."""

    harmonics: int = 3  # of a phase, at most
    knot_s: float = 4.0  # between corrections of the phase
    bend: float = 0.3  # of the phase's second differences, over the data's mean weight
    small: float = 0.01  # the same of the phase itself
    rounds: int = 6  # of Gauss-Newton
    folds: int = 6  # of the time, each predicted from the others
    predicted: float = 0.3  # share of the variance that a rhythm predicts in frames it was not fitted to
    rates_hz: Span = (0.08, 3.5)  # slowest breath, quickest heart
    periods: float = 3.0  # that the frames must span: fewer are a drift
    most: int = 3  # rhythms (heart, breath, what is left of either), and as many attempts that are none
    even: float = 3.0  # 95th percentile of amplitude over median: without, 4 of 23 videos have a false pulse
    least_px: float = 0.03  # of amplitude; less is the flow's own error
    main: int = 6  # components of the motion that rates are searched in; the rest is noise
    faster: float = 0.95  # share of the loss at a rate that twice or three times that rate must be below
    alike: float = 0.03  # relative distance of a rate from another's harmonic that is the same


RHYTHM = RhythmConstants()


@dataclass(frozen=True, eq=False)
class Rhythm:
    """A motion of the whole surface that follows the harmonics of one phase."""

    rate_hz: float
    knots_s: Floats  # (K,) times at which the phase is corrected
    lead: Floats  # (K,) by how much it is ahead of the rate there [rad]
    harmonics: int
    modes: Floats = field(default_factory=lambda: np.zeros((0, 0, 0)))
    """(2 H, B, C) coefficients of the polynomials, for each wave; empty before the fit."""

    def phase(self, time_s: Floats) -> Floats:
        """(T,) rad."""
        return np.asarray(
            2 * np.pi * self.rate_hz * time_s + np.interp(time_s, self.knots_s, self.lead), np.float64
        )

    def waves(self, time_s: Floats) -> Floats:
        """(T, 2 H) cosine and sine of each harmonic."""
        return _waves(self.phase(time_s), self.harmonics)

    def at(self, time_s: Floats) -> Floats:
        """(T, B, C) coefficients of the motion."""
        return np.asarray(np.tensordot(self.waves(time_s), self.modes, axes=1), np.float64)

    def amplitude(self, basis: Floats) -> Floats:
        """(P,) half of the way from one end to the other at places of the basis (P, B)."""
        turn = _waves(np.linspace(0, 2 * np.pi, 48, endpoint=False), self.harmonics)
        path = np.einsum("pa,tac->tpc", basis, np.tensordot(turn, self.modes, axes=1))
        return np.asarray(np.linalg.norm(np.ptp(path, axis=0), axis=1) / 2, np.float64)


def find_rhythms(
    t: Floats, coefficients: Floats, basis: Floats
) -> tuple[tuple[Rhythm, ...], tuple[Rhythm, ...]]:
    """The rhythms of a motion, the strongest first, each found in what those before it leave.

    Args:
        t: (T,) s.
        coefficients: (T, B, C) of the motion.
        basis: (P, B) the polynomials at places of the surface.

    Returns:
        Those that repeat, predict frames and move all places alike; and what had to be fitted before the last
        of them but does not.
    """
    # In these coordinates a length is a length of motion over the places.
    metric = np.linalg.cholesky(basis.T @ basis / len(basis) + 1e-12 * np.eye(basis.shape[1])).T
    y = np.einsum("ab,tbc->tac", metric, coefficients).reshape(len(t), -1)
    back = np.linalg.inv(metric)
    found: list[Rhythm] = []
    best: list[Rhythm] = []
    accepted: list[bool] = []
    while accepted.count(True) < RHYTHM.most and accepted.count(False) < RHYTHM.most:
        rate = _strongest_rate(t, y, found)
        if rate is None:
            break
        found, periodic = _add_rhythm(t, y, found, rate)
        if _is_harmonic(found):
            break
        size = fit(t, y, found, back)[-1].amplitude(basis)
        if np.median(size) < RHYTHM.least_px:
            break
        accepted.append(periodic and bool(np.percentile(size, 95) <= RHYTHM.even * np.median(size)))
        # What comes after the last rhythm is noise, and fitting it would do harm.
        best = found if accepted[-1] else best
    fitted = list(zip(fit(t, y, best, back), accepted, strict=False))
    return tuple(one for one, own in fitted if own), tuple(one for one, own in fitted if not own)


def fit(t: Floats, y: Floats, rhythms: Sequence[Rhythm], back: Floats) -> list[Rhythm]:
    """Rhythms of known phases with the modes that fit a motion best, besides a constant and a drift.

    Args:
        t: (T,) s.
        y: (T, B C) coefficients of the motion, maybe in other coordinates.
        rhythms: their phases.
        back: (B, B) what brings those coordinates back.
    """
    weights = np.linalg.lstsq(_design(t, rhythms), y, rcond=None)[0]
    modes = np.einsum("ab,kbc->kac", back, weights.reshape(len(weights), len(back), -1))
    ends = np.cumsum([2, *(2 * one.harmonics for one in rhythms)])
    return [replace(one, modes=modes[a:b]) for one, a, b in zip(rhythms, ends, ends[1:], strict=False)]


def visible_rates(t: Floats) -> Span | None:
    """Lowest and highest rate that frames at times (T,) s can show [Hz]; None: they show none."""
    low = max(RHYTHM.rates_hz[0], RHYTHM.periods / max(float(np.ptp(t)), 1e-9))
    high = min(RHYTHM.rates_hz[1], 0.45 / float(np.median(np.diff(t))))
    return (low, high) if low < high else None


def _waves(phase: Floats, harmonics: int) -> Floats:
    """(T, 2 H) cosine and sine of each harmonic of a phase (T,) [rad]."""
    turns = phase[:, None] * np.arange(1, harmonics + 1)
    return np.stack([np.cos(turns), np.sin(turns)], axis=2).reshape(len(phase), -1)


def _design(t: Floats, rhythms: Sequence[Rhythm]) -> Floats:
    """(T, K) a constant (the rest frame's noise), a drift, and each rhythm's waves."""
    middle = (t - t.mean()) / max(float(np.ptp(t)), 1e-9)
    parts = [np.ones((len(t), 1)), middle[:, None], *(one.waves(t) for one in rhythms)]
    return np.concatenate(parts, axis=1)


def _harmonics(t: Floats, rate_hz: float) -> int:
    """As many as the frames can tell apart."""
    return int(np.clip(0.4 / float(np.median(np.diff(t))) // rate_hz, 1, RHYTHM.harmonics))


def _strongest_rate(t: Floats, y: Floats, rhythms: Sequence[Rhythm]) -> float | None:
    """The rate whose waves explain most of what is left (Lomb 1976; Scargle 1982)."""
    rates_hz = visible_rates(t)
    if rates_hz is None:
        return None
    known = _design(t, rhythms)
    u, s, _ = np.linalg.svd(y - known @ np.linalg.lstsq(known, y, rcond=None)[0], full_matrices=False)
    main = u[:, : RHYTHM.main] * s[: RHYTHM.main]

    def loss(rate: float) -> float:
        columns = np.concatenate([known, _waves(2 * np.pi * rate * t, _harmonics(t, rate))], axis=1)
        gram, right = columns.T @ columns, columns.T @ main
        gram += 1e-9 * np.trace(gram) * np.eye(len(gram))
        return -float((right * np.linalg.solve(gram, right)).sum())

    step = 1 / (6 * float(np.ptp(t)))
    best: float = min(np.arange(*rates_hz, step).tolist(), key=loss)
    # A half or a third of the rate has the same waves among its own: the fastest that does as well is meant.
    for order in (3, 2):
        if order * best < rates_hz[1]:
            around = np.linspace(order * best - 2 * step, order * best + 2 * step, 17)
            faster: float = min(around.tolist(), key=loss)
            if loss(faster) < RHYTHM.faster * loss(best):
                best = faster
                break
    return float(minimize_scalar(loss, bounds=(best - step, best + step), method="bounded").x)


def _add_rhythm(t: Floats, y: Floats, rhythms: Sequence[Rhythm], rate: float) -> tuple[list[Rhythm], bool]:
    """The rhythms refined together with one of that rate, and whether that one is periodic.

    Few frames can't tell three harmonics: it has as many as predict what they weren't fitted to.
    """
    count = max(2, round(float(np.ptp(t)) / max(RHYTHM.knot_s, 3 / rate)) + 1)
    knots = np.linspace(t[0], t[-1], count)
    refined: list[Rhythm] = []
    for harmonics in range(_harmonics(t, rate), 0, -1):
        refined = _refine(t, y, [*rhythms, Rhythm(rate, knots, np.zeros(count), harmonics)])
        if _predicts(t, y, refined):
            # Its phase, running behind, may have made it too slow to repeat in so short a time.
            return refined, float(np.ptp(refined[-1].phase(t))) / (2 * np.pi) >= RHYTHM.periods - 0.5
    return refined, False


def _refine(t: Floats, y: Floats, rhythms: Sequence[Rhythm]) -> list[Rhythm]:
    """The phases' leads by Gauss-Newton on the residual, smooth by a prior."""
    now = list(rhythms)
    for _ in range(RHYTHM.rounds):
        design = _design(t, now)
        weights = np.linalg.lstsq(design, y, rcond=None)[0]
        left, at = y - design @ weights, 2
        for k, one in enumerate(now):
            waves = one.waves(t).reshape(len(t), one.harmonics, 2)
            order = np.arange(1, one.harmonics + 1)[:, None]
            slope = (np.stack([-waves[..., 1], waves[..., 0]], axis=2) * order).reshape(len(t), -1)
            change = slope @ weights[at : at + 2 * one.harmonics]
            at += 2 * one.harmonics
            count = len(one.lead)
            hats = np.stack([np.interp(t, one.knots_s, row) for row in np.eye(count)], axis=1)
            normal = (hats * np.square(change).sum(axis=1)[:, None]).T @ hats
            bend = np.diff(np.eye(count), 2, axis=0) if count > 2 else np.zeros((1, count))
            weight = float(np.trace(normal)) / count
            normal += weight * (RHYTHM.bend * bend.T @ bend + RHYTHM.small * np.eye(count))
            pull = hats.T @ (change * left).sum(axis=1) - weight * RHYTHM.bend * bend.T @ (bend @ one.lead)
            now[k] = replace(one, lead=one.lead + np.linalg.solve(normal, pull))
    return now


def _predicts(t: Floats, y: Floats, rhythms: Sequence[Rhythm]) -> bool:
    """Whether the last rhythm, fitted to five sixths of the time, predicts the last sixth, each in turn."""
    fold = np.arange(len(t)) * RHYTHM.folds // len(t)

    def error(design: Floats) -> float:
        total = 0.0
        for k in range(RHYTHM.folds):
            out = fold == k
            predicted = design[out] @ np.linalg.lstsq(design[~out], y[~out], rcond=None)[0]
            total += float(np.square(y[out] - predicted).sum())
        return total

    return error(_design(t, rhythms)) < (1 - RHYTHM.predicted) * error(_design(t, rhythms[:-1]))


def _is_harmonic(rhythms: Sequence[Rhythm]) -> bool:
    """Whether the last rate is one of the others, or a harmonic of it."""
    *others, last = (one.rate_hz for one in rhythms)
    return any(abs(last - order * rate) < RHYTHM.alike * last for rate in others for order in (0.5, 1, 2, 3))
