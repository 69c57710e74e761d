"""Fit of rhythms, harmonics of a phase of slowly varying rate, to the coefficients of a smooth motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize_scalar

from synth.arrays import Floats

Span = tuple[float, float]


class Fit:
    """Constants of rhythms, chosen by hand on the videos of tests/synth/flow/recording/test_pulse.py."""

    max_harmonics: int = 3  # most harmonics of a phase
    knot_s: float = 4.0  # between corrections of the phase
    bend: float = 0.3  # prior on second differences of the phase, over the mean weight of the data
    phase_prior: float = 0.01  # prior on the correction of the phase, likewise
    iterations: int = 6  # Gauss-Newton iterations
    folds: int = 6  # of cross-validation over time
    min_predicted: float = 0.3  # least share of the variance of held-out frames that a rhythm predicts
    rates_hz: Span = (0.08, 3.5)  # slowest breath, fastest heart rate
    min_periods: float = 3.0  # least number of periods in the frames: fewer look like drift
    max_rhythms: int = 3  # most accepted rhythms (heart, breath, residual), and most rejected ones
    max_unevenness: float = 3.0  # 95th percentile of amplitude over median: without, 4 of 23 videos pulsate
    min_amplitude_px: float = 0.03  # least median amplitude: the error of the flow is of this size
    components: int = 6  # principal components of the motion in which rates are searched
    min_faster_share: float = 0.95  # of the explained variance that two or three times the best rate reaches
    rate_tolerance: float = 0.03  # relative distance below which a rate equals a harmonic of another


@dataclass(frozen=True, eq=False)
class Rhythm:
    """Motion of the whole surface as harmonics of one phase."""

    rate_hz: float
    knots_s: Floats  # (K,) times at which the phase is corrected
    lead: Floats  # (K,) correction of the phase at these times [rad]
    harmonics: int
    # (2 H, B, C) coefficients of the B polynomials for each wave and component; empty before the fit.
    modes: Floats = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def phase(self, time_s: Floats) -> Floats:
        """Phase (T,) [rad]."""
        return np.asarray(2 * np.pi * self.rate_hz * time_s + np.interp(time_s, self.knots_s, self.lead))

    def waves(self, time_s: Floats) -> Floats:
        """Cosine and sine (T, 2 H) of each harmonic."""
        return _waves(self.phase(time_s), self.harmonics)

    def at(self, time_s: Floats) -> Floats:
        """Coefficients (T, B, C) of the motion."""
        return np.asarray(np.tensordot(self.waves(time_s), self.modes, axes=1), np.float64)

    def amplitude(self, basis: Floats) -> Floats:
        """Amplitude (P,), half of the peak-to-peak motion, at places of the basis (P, B)."""
        cycle = _waves(np.linspace(0, 2 * np.pi, 48, endpoint=False), self.harmonics)
        path = np.einsum("pa,tac->tpc", basis, np.tensordot(cycle, self.modes, axes=1))
        return np.asarray(np.linalg.norm(np.ptp(path, axis=0), axis=1) / 2, np.float64)


def find_rhythms(
    t: Floats, coefficients: Floats, basis: Floats
) -> tuple[tuple[Rhythm, ...], tuple[Rhythm, ...]]:
    """Accepted and rejected rhythms, the strongest first, of a motion's coefficients (T, B, C) at (T,) s.

    Each is found in the residual of the previous ones. Accepted ones are periodic, predict held-out frames
    and move the surface evenly; rejected ones are stronger than the last accepted one and must be fitted with
    it. `basis`: (P, B) polynomials at places of the surface.
    """
    # In these coordinates the norm is the root mean square of the motion over the places.
    metric = np.linalg.cholesky(basis.T @ basis / len(basis) + 1e-12 * np.eye(basis.shape[1])).T
    y = np.einsum("ab,tbc->tac", metric, coefficients).reshape(len(t), -1)
    inverse = np.linalg.inv(metric)
    candidates, selected, accepted = list[Rhythm](), list[Rhythm](), list[bool]()
    while accepted.count(True) < Fit.max_rhythms and accepted.count(False) < Fit.max_rhythms:
        rate = _find_strongest_rate(t, y, candidates)
        if rate is None:
            break
        candidates, periodic = _add_rhythm(t, y, candidates, rate)
        if _is_harmonic(candidates):
            break
        amplitude = fit(t, y, candidates, inverse)[-1].amplitude(basis)
        if np.median(amplitude) < Fit.min_amplitude_px:
            break
        accepted.append(
            periodic and bool(np.percentile(amplitude, 95) <= Fit.max_unevenness * np.median(amplitude))
        )
        # Rejected rhythms after the last accepted one are noise and are not fitted.
        selected = candidates if accepted[-1] else selected
    fitted = list(zip(fit(t, y, selected, inverse), accepted, strict=False))
    rhythms = tuple(rhythm for rhythm, is_accepted in fitted if is_accepted)
    return rhythms, tuple(rhythm for rhythm, is_accepted in fitted if not is_accepted)


def fit(t: Floats, y: Floats, rhythms: Sequence[Rhythm], inverse: Floats) -> list[Rhythm]:
    """Rhythms of known phase with their modes, fitted with a constant and a drift to coefficients `y`
    (T, B C) at times (T,) s by least squares; `inverse` (B, B) transforms from the coordinates of `y`."""
    weights = np.linalg.lstsq(_design(t, rhythms), y, rcond=None)[0]
    modes = np.einsum("ab,kbc->kac", inverse, weights.reshape(len(weights), len(inverse), -1))
    ends = np.cumsum([2, *(2 * rhythm.harmonics for rhythm in rhythms)])
    return [replace(rhythm, modes=modes[a:b]) for rhythm, a, b in zip(rhythms, ends, ends[1:], strict=False)]


def visible_rates(t: Floats) -> Span | None:
    """Lowest and highest rate [Hz] that frames at times (T,) s can resolve; None: there is none."""
    low = max(Fit.rates_hz[0], Fit.min_periods / max(float(np.ptp(t)), 1e-9))
    high = min(Fit.rates_hz[1], 0.45 / float(np.median(np.diff(t))))
    return (low, high) if low < high else None


def _waves(phase: Floats, harmonics: int) -> Floats:
    """Cosine and sine (T, 2 H) of each harmonic of a phase (T,) [rad]."""
    phases = phase[:, None] * np.arange(1, harmonics + 1)
    return np.stack([np.cos(phases), np.sin(phases)], axis=2).reshape(len(phase), -1)


def _design(t: Floats, rhythms: Sequence[Rhythm]) -> Floats:
    """Design matrix (T, K): a constant (noise of the rest frame), a drift, and the waves of each rhythm."""
    middle = (t - t.mean()) / max(float(np.ptp(t)), 1e-9)
    blocks = [np.ones((len(t), 1)), middle[:, None], *(rhythm.waves(t) for rhythm in rhythms)]
    return np.concatenate(blocks, axis=1)


def _harmonics(t: Floats, rate_hz: float) -> int:
    """Number of harmonics that the frames can resolve."""
    return int(np.clip(0.4 / float(np.median(np.diff(t))) // rate_hz, 1, Fit.max_harmonics))


def _find_strongest_rate(t: Floats, y: Floats, rhythms: Sequence[Rhythm]) -> float | None:
    """Rate whose waves explain most of the residual (Lomb 1976; Scargle 1982); None: there is none."""
    rates_hz = visible_rates(t)
    if rates_hz is None:
        return None
    design = _design(t, rhythms)
    residual = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
    if not residual.any():  # tissue that never moves has no rate
        return None
    u, s, _ = np.linalg.svd(residual, full_matrices=False)
    components = u[:, : Fit.components] * s[: Fit.components]

    def loss(rate: float) -> float:
        columns = np.concatenate([design, _waves(2 * np.pi * rate * t, _harmonics(t, rate))], axis=1)
        gram, rhs = columns.T @ columns, columns.T @ components
        gram += 1e-9 * np.trace(gram) * np.eye(len(gram))
        return -float((rhs * np.linalg.solve(gram, rhs)).sum())

    step = 1 / (6 * float(np.ptp(t)))
    best_rate: float = min(np.arange(*rates_hz, step).tolist(), key=loss)
    # The waves of half or a third of a rate include its own: the fastest rate of similar fit is right.
    for order in (3, 2):
        if order * best_rate < rates_hz[1]:
            candidates = np.linspace(order * best_rate - 2 * step, order * best_rate + 2 * step, 17)
            faster_rate: float = min(candidates.tolist(), key=loss)
            if loss(faster_rate) < Fit.min_faster_share * loss(best_rate):
                best_rate = faster_rate
                break
    return float(minimize_scalar(loss, bounds=(best_rate - step, best_rate + step), method="bounded").x)


def _add_rhythm(t: Floats, y: Floats, rhythms: Sequence[Rhythm], rate: float) -> tuple[list[Rhythm], bool]:
    """The rhythms refined with a new one of this rate, of the largest number of harmonics that predicts
    held-out frames, and whether the new one is periodic."""
    count = max(2, round(float(np.ptp(t)) / max(Fit.knot_s, 3 / rate)) + 1)
    knots = np.linspace(t[0], t[-1], count)
    refined: list[Rhythm] = []
    for harmonics in range(_harmonics(t, rate), 0, -1):
        refined = _refine(t, y, [*rhythms, Rhythm(rate, knots, np.zeros(count), harmonics)])
        if _predicts(t, y, refined):
            # The correction of the phase may have made it too slow to repeat in the frames.
            return refined, float(np.ptp(refined[-1].phase(t))) / (2 * np.pi) >= Fit.min_periods - 0.5
    return refined, False


def _refine(t: Floats, y: Floats, rhythms: Sequence[Rhythm]) -> list[Rhythm]:
    """Refines the corrections of the phases by Gauss-Newton with a smoothness prior."""
    refined = list(rhythms)
    for _ in range(Fit.iterations):
        design = _design(t, refined)
        weights = np.linalg.lstsq(design, y, rcond=None)[0]
        residual, column = y - design @ weights, 2
        for k, rhythm in enumerate(refined):
            waves = rhythm.waves(t).reshape(len(t), rhythm.harmonics, 2)
            order = np.arange(1, rhythm.harmonics + 1)[:, None]
            slope = (np.stack([-waves[..., 1], waves[..., 0]], axis=2) * order).reshape(len(t), -1)
            change = slope @ weights[column : column + 2 * rhythm.harmonics]
            column += 2 * rhythm.harmonics
            count = len(rhythm.lead)
            hats = np.stack([np.interp(t, rhythm.knots_s, row) for row in np.eye(count)], axis=1)
            normal = (hats * np.square(change).sum(axis=1)[:, None]).T @ hats
            bend = np.diff(np.eye(count), 2, axis=0) if count > 2 else np.zeros((1, count))
            weight = float(np.trace(normal)) / count
            normal += weight * (Fit.bend * bend.T @ bend + Fit.phase_prior * np.eye(count))
            pull = hats.T @ (change * residual).sum(axis=1)
            pull = pull - weight * Fit.bend * bend.T @ (bend @ rhythm.lead)
            refined[k] = replace(rhythm, lead=rhythm.lead + np.linalg.solve(normal, pull))
    return refined


def _predicts(t: Floats, y: Floats, rhythms: Sequence[Rhythm]) -> bool:
    """Whether the last rhythm predicts frames in cross-validation over six parts of the time."""
    fold = np.arange(len(t)) * Fit.folds // len(t)

    def error(design: Floats) -> float:
        total = 0.0
        for k in range(Fit.folds):
            held_out = fold == k
            prediction = design[held_out] @ np.linalg.lstsq(design[~held_out], y[~held_out], rcond=None)[0]
            total += float(np.square(y[held_out] - prediction).sum())
        return total

    return error(_design(t, rhythms)) < (1 - Fit.min_predicted) * error(_design(t, rhythms[:-1]))


def _is_harmonic(rhythms: Sequence[Rhythm]) -> bool:
    """Whether the last rate equals another rate, its half, or a harmonic of it."""
    *others, last = (rhythm.rate_hz for rhythm in rhythms)
    return any(
        abs(last - order * rate) < Fit.rate_tolerance * last for rate in others for order in (0.5, 1, 2, 3)
    )
