"""Intervals fitted on answers whose errors are drawn from a formula, strongly alike within a sequence."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.features import MOTION
from learn.uncertainty.intervals import Example, Intervals, Prediction, fit, make_example
from learn.uncertainty.out_of_distribution import fit_distribution
from synth.errors import UserError

Floats = NDArray[np.float64]

UNIT_MN = 100.0
FRAMES, N, PITCH_MM = 5, 16, 2.0


def draw(
    rng: np.random.Generator, directed: bool = True, noise: float = 0.2, moved: float = 0.0
) -> tuple[Prediction, Floats]:
    """One sequence: its answer, off by a share that is mostly the sequence's own, and the force (T, 3).

    `moved`: added to the logarithm of motion and to its divergence: another world.
    """
    force = rng.normal(size=3) * 60 * np.sin(np.linspace(0.2, 1.5, FRAMES))[:, None]
    size = np.linalg.norm(force, axis=1)
    motion = np.column_stack(
        [
            np.log(0.05 + size / 100) + 0.1 * rng.normal(size=FRAMES) + moved,
            0.3 * rng.normal() + 0.1 * rng.normal(size=FRAMES) - moved,
            *(0.5 + 0.1 * rng.normal(size=(4, FRAMES))),
        ]
    )
    share = 1 + noise * rng.normal() + 0.1 * noise * rng.normal(size=(FRAMES, 1))
    told = share * force + noise * rng.normal(size=3) * size[:, None]
    if not directed:
        told = np.column_stack([np.linalg.norm(told, axis=1), *np.full((2, FRAMES), np.nan)])
    bump = np.exp(-(((np.indices((N, N)) - rng.uniform(5, 11, (2, 1, 1))) / 2.5) ** 2).sum(0))
    true = (size[:, None, None] / 100 * bump).astype(np.float32)
    return Prediction(motion, told, np.abs(share[..., None]).astype(np.float32) * true, PITCH_MM), force


def example(drawn: tuple[Prediction, Floats], unit: int) -> Example:
    return make_example(*drawn, unit, UNIT_MN)


def fitted(rng: np.random.Generator, kept: int = 19, directed: bool = True, chosen: int = 30) -> Intervals:
    """Intervals of `kept` sequences, their scale from others and the distance from others again."""
    first = [example(draw(rng, directed), k) for k in range(chosen)]
    last = [example(draw(rng, directed), k) for k in range(kept)]
    world = fit_distribution([draw(rng)[0].motion for _ in range(60)], [one.motion for one in first])
    assert world is not None
    return fit(first, last, world, MOTION, UNIT_MN, "recovered")


def held(found: Intervals, said: Prediction, force: Floats, level: float) -> Floats:
    """Shares within the interval: of size, x, y and z."""
    band = found.bound(said, level)
    size = np.linalg.norm(force, axis=1)
    axes = (force >= band.axes_low) & (force <= band.axes_high)
    return np.array([((size >= band.low) & (size <= band.high)).mean(), *axes.mean(0)])


@pytest.mark.slow
@pytest.mark.parametrize("directed", [True, False])
def test_new_sequences_are_covered_as_often_as_is_said(directed: bool) -> None:
    rng = np.random.default_rng(int(directed))
    shares: dict[float, list[Floats]] = {level: [] for level in LEVELS}
    for _ in range(60):
        found = fitted(rng, directed=directed)
        for _ in range(10):
            said, truth = draw(rng, directed)
            for level in LEVELS:
                shares[level].append(held(found, said, truth, level))
    for level, rows in shares.items():
        by_fit = np.array(rows).reshape(60, 10, 4).mean(1)
        error = by_fit.std(0) / np.sqrt(60)
        assert (by_fit.mean(0) >= level - 3 * error).all()
        # One unit more than the level is what 19 of them can't resolve.
        assert (by_fit.mean(0) <= level + 1 / 20 + 3 * error).all()


def test_an_interval_holds_its_answer_and_a_size_is_not_negative() -> None:
    rng = np.random.default_rng(2)
    found = fitted(rng)
    for _ in range(20):
        said, _ = draw(rng)
        wide, narrow = (found.bound(said, level) for level in LEVELS)
        assert (wide.low <= narrow.low).all()
        assert (narrow.low <= said.size).all()
        assert (said.size <= narrow.high).all()
        assert (narrow.high <= wide.high).all()
        assert (wide.low >= 0).all()
        assert ((wide.axes_low < said.force) & (said.force < wide.axes_high)).all()


def test_sequences_of_one_brain_are_one_unit_and_too_few_are_refused() -> None:
    rng = np.random.default_rng(8)
    found = fitted(rng, kept=9)
    assert (found.units, found.sequences) == (9, 9)
    with pytest.raises(UserError, match="8"):
        fitted(rng, kept=8)
    first = [example(draw(rng), k) for k in range(5)]
    last = [example(draw(rng), k // 3) for k in range(24)]
    world = fit_distribution([one.motion for one in first], [one.motion for one in first])
    assert world is not None
    with pytest.raises(UserError, match="8"):
        fit(first, last, world, MOTION, UNIT_MN, "recovered")
