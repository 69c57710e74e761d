"""Intervals fitted on answers whose errors are drawn from a formula, strongly alike within a sequence."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.features import MOTION
from learn.uncertainty.intervals import Example, Intervals, Said, Truth, fit, make_example
from learn.uncertainty.world import fit_world
from synth.errors import UserError

Floats = NDArray[np.float64]

UNITS = (100.0, 2.0)
FRAMES, N, PITCH_MM = 5, 16, 2.0
MASK = np.ones((N, N), np.float32)


def draw(
    rng: np.random.Generator, directed: bool = True, noise: float = 0.2, moved: float = 0.0
) -> tuple[Said, Truth]:
    """One sequence: a force and its answer, off by a share that is the sequence's own and little else.

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
    return Said(motion, told, np.abs(share[..., None]).astype(np.float32) * true, PITCH_MM), Truth(
        force, true
    )


def example(said: Said, truth: Truth, unit: int, rng: np.random.Generator) -> Example:
    return make_example(said, truth, MASK, unit, UNITS, rng, most_cells=200)


def fitted(rng: np.random.Generator, kept: int = 19, directed: bool = True, chosen: int = 30) -> Intervals:
    """Intervals of `kept` sequences, their scale from others and the distance from others again."""
    first = [example(*draw(rng, directed), k, rng) for k in range(chosen)]
    last = [example(*draw(rng, directed), k, rng) for k in range(kept)]
    world = fit_world([draw(rng)[0].motion for _ in range(60)], [one.motion for one in first])
    assert world is not None
    return fit(first, last, world, MOTION, UNITS, "recovered")


def held(found: Intervals, said: Said, truth: Truth, level: float) -> Floats:
    """Shares within the interval: of size, x, y, z and the map's cells."""
    band = found.bound(said, level)
    size = np.linalg.norm(truth.force, axis=1)
    low, high = found.bound_map(said, level)
    axes = (truth.force >= band.axes_low) & (truth.force <= band.axes_high)
    whole = (truth.magnitude >= low) & (truth.magnitude <= high)
    return np.array([((size >= band.low) & (size <= band.high)).mean(), *axes.mean(0), whole.mean()])


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
        by_fit = np.array(rows).reshape(60, 10, 5).mean(1)
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
        low, high = found.bound_map(said)
        assert ((low >= 0) & (low <= said.magnitude) & (said.magnitude <= high)).all()


def test_components_that_are_not_said_are_wide_and_around_zero() -> None:
    rng = np.random.default_rng(3)
    found = fitted(rng, directed=False)
    said, _ = draw(rng, directed=False)
    band = found.bound(said)
    assert band.axes_low == pytest.approx(-band.axes_high)
    # A force of known size and any direction has components that go up to about its size.
    assert (band.axes_high.min(1) > 0.4 * said.size).all()
    assert np.isfinite(band.axes_high).all()


def test_another_world_widens_by_its_distance() -> None:
    rng = np.random.default_rng(4)
    found = fitted(rng)
    said, truth = draw(rng)
    other = Said(said.motion + np.array([0, 0, 0, 3.0, 0, 0]), said.force, said.magnitude, PITCH_MM)
    factor = found.world.widening(other.motion)
    assert (factor > 2).all()
    base, wide = found.bound(said), found.bound(other)
    # Beyond what it was fitted on the scale goes on as at its edge, so that the distance alone speaks.
    edge = Said(
        np.clip(other.motion, found.size.scale.low[:6], found.size.scale.high[:6]),
        said.force, said.magnitude, PITCH_MM,
    )  # fmt: skip
    at_edge = found.bound(edge)
    stretched = (wide.high - said.size) * found.world.widening(edge.motion) / factor
    assert stretched == pytest.approx(at_edge.high - said.size)
    assert (wide.axes_high - wide.axes_low > 1.5 * (base.axes_high - base.axes_low)).all()
    assert held(found, other, truth, 0.9)[0] >= held(found, said, truth, 0.9)[0]


def test_a_force_beyond_all_that_was_seen_widens_in_proportion() -> None:
    rng = np.random.default_rng(5)
    found = fitted(rng)
    said, _ = draw(rng)
    ten, hundred = (
        Said(said.motion, said.force / said.size[:, None] * f, said.magnitude, PITCH_MM) for f in (1e4, 1e5)
    )
    ratio = (found.bound(hundred).high - hundred.size) / (found.bound(ten).high - ten.size)
    assert ratio == pytest.approx(10, rel=1e-2)


def test_more_noise_is_wider() -> None:
    rng = np.random.default_rng(6)
    width = []
    for noise in (0.05, 0.4):
        first = [example(*draw(rng, noise=noise), k, rng) for k in range(20)]
        last = [example(*draw(rng, noise=noise), k, rng) for k in range(12)]
        world = fit_world([draw(rng)[0].motion for _ in range(30)], [one.motion for one in first])
        assert world is not None
        found = fit(first, last, world, MOTION, UNITS, "recovered")
        band = found.bound(draw(np.random.default_rng(7))[0])
        width.append((band.high - band.low).mean())
    assert width[1] > 4 * width[0]


def test_sequences_of_one_brain_are_one_unit_and_too_few_are_refused() -> None:
    rng = np.random.default_rng(8)
    found = fitted(rng, kept=9)
    assert (found.units, found.sequences) == (9, 9)
    with pytest.raises(UserError, match="8 brains are kept"):
        fitted(rng, kept=8)
    first = [example(*draw(rng), k, rng) for k in range(5)]
    last = [example(*draw(rng), k // 3, rng) for k in range(24)]
    world = fit_world([one.motion for one in first], [one.motion for one in first])
    assert world is not None
    with pytest.raises(UserError, match="8 brains are kept"):
        fit(first, last, world, MOTION, UNITS, "recovered")


def test_a_level_that_there_is_none_of() -> None:
    rng = np.random.default_rng(9)
    with pytest.raises(UserError, match=r"level 0\.5: the model has intervals of 0\.9, 0\.68"):
        fitted(rng).bound(draw(rng)[0], 0.5)
