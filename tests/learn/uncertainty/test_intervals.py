"""Intervals fitted on estimates with drawn errors that correlate strongly within a sequence."""

import numpy as np
import pytest
from numpy.typing import NDArray

from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.features import MOTION
from learn.uncertainty.intervals import Intervals, Prediction, fit, make_example
from learn.uncertainty.out_of_distribution import fit_distribution
from synth.errors import UserError

Floats = NDArray[np.float64]

UNIT_MN = 100.0
FRAMES, N, PITCH_MM = 5, 16, 2.0


def draw(rng: np.random.Generator, directed: bool = True) -> tuple[Prediction, Floats]:
    """One sequence's estimate, whose relative error varies mostly by sequence, and the force (T, 3)."""
    force = rng.normal(size=3) * 60 * np.sin(np.linspace(0.2, 1.5, FRAMES))[:, None]
    size = np.linalg.norm(force, axis=1)
    first = np.log(0.05 + size / 100) + 0.1 * rng.normal(size=FRAMES)
    second = 0.3 * rng.normal() + 0.1 * rng.normal(size=FRAMES)
    motion = np.column_stack([first, second, *(0.5 + 0.1 * rng.normal(size=(4, FRAMES)))])
    share = 1 + 0.2 * rng.normal() + 0.1 * 0.2 * rng.normal(size=(FRAMES, 1))
    estimate = share * force + 0.2 * rng.normal(size=3) * size[:, None]
    if not directed:
        estimate = np.column_stack([np.linalg.norm(estimate, axis=1), *np.full((2, FRAMES), np.nan)])
    bump = np.exp(-(((np.indices((N, N)) - rng.uniform(5, 11, (2, 1, 1))) / 2.5) ** 2).sum(0))
    true = (size[:, None, None] / 100 * bump).astype(np.float32)
    return Prediction(motion, estimate, np.abs(share[..., None]).astype(np.float32) * true, PITCH_MM), force


def fit_intervals(
    rng: np.random.Generator, count: int = 19, directed: bool = True, per_unit: int = 1
) -> Intervals:
    """Intervals with factors from `count` sequences; error models and distribution are from others."""
    first = [make_example(*draw(rng, directed), k, UNIT_MN) for k in range(30)]
    last = [make_example(*draw(rng, directed), k // per_unit, UNIT_MN) for k in range(count)]
    distribution = fit_distribution(
        [draw(rng)[0].motion for _ in range(60)], [example.motion for example in first]
    )
    return fit(first, last, distribution, MOTION, UNIT_MN, "recovered")


def coverage(intervals: Intervals, estimate: Prediction, force: Floats, level: float) -> Floats:
    """Coverage of size, x, y and z."""
    band = intervals.bound(estimate, level)
    size = np.linalg.norm(force, axis=1)
    axes = (force >= band.axes_low) & (force <= band.axes_high)
    return np.array([((size >= band.low) & (size <= band.high)).mean(), *axes.mean(0)])


@pytest.mark.slow
@pytest.mark.parametrize("directed", [True, False])
def test_new_sequences_are_covered_at_the_nominal_level(directed: bool) -> None:
    rng = np.random.default_rng(int(directed))
    shares: dict[float, list[Floats]] = {level: [] for level in LEVELS}
    for _ in range(60):
        intervals = fit_intervals(rng, directed=directed)
        for _ in range(10):
            estimate, truth = draw(rng, directed)
            for level in LEVELS:
                shares[level].append(coverage(intervals, estimate, truth, level))
    for level, rows in shares.items():
        by_fit = np.array(rows).reshape(60, 10, 4).mean(1)
        error = by_fit.std(0) / np.sqrt(60)
        assert (by_fit.mean(0) >= level - 3 * error).all()
        # The resolution of 19 units.
        assert (by_fit.mean(0) <= level + 1 / 20 + 3 * error).all()


def test_an_interval_contains_the_estimate_and_sizes_are_not_negative() -> None:
    rng = np.random.default_rng(2)
    intervals = fit_intervals(rng)
    for _ in range(20):
        estimate, _ = draw(rng)
        wide, narrow = (intervals.bound(estimate, level) for level in LEVELS)
        ends = np.array([0 * wide.low, wide.low, narrow.low, estimate.size, narrow.high, wide.high])
        assert (np.diff(ends, axis=0) >= 0).all()
        assert ((wide.axes_low < estimate.force) & (estimate.force < wide.axes_high)).all()


def test_sequences_of_one_brain_are_one_unit_and_too_few_are_refused() -> None:
    rng = np.random.default_rng(8)
    intervals = fit_intervals(rng, count=9)
    assert (intervals.units, intervals.sequences) == (9, 9)
    for count, per_unit in ((8, 1), (24, 3)):
        with pytest.raises(UserError, match="8"):
            fit_intervals(rng, count=count, per_unit=per_unit)
