from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from learn.evaluation.metrics import Moments
from learn.evaluation.statistics import interval, paired, pooled_r2, pooled_r2_difference, skill
from learn.training.train import cosine
from synth.errors import UserError


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_a_difference_of_pooled_r2_is_that_of_its_parts() -> None:
    draw = np.random.default_rng(3)
    true = draw.normal(size=(20, 30))

    def moments(noise: float) -> np.ndarray:
        said = true + noise * draw.normal(size=true.shape)
        return np.array([dataclasses.astuple(Moments.of(t, s))[:6] for t, s in zip(true, said, strict=True)])

    a, b = (np.stack([moments(noise), moments(noise)], axis=1) for noise in (0.5, 0.2))
    found = pooled_r2_difference(a, b, np.random.default_rng(0))
    single = [[pooled_r2(m[:, k], np.random.default_rng(0)).mean for k in (0, 1)] for m in (a, b)]
    assert found.mean == pytest.approx(np.mean(single[1]) - np.mean(single[0]))
    assert 0 < found.low < found.mean < found.high
    assert pooled_r2_difference(a, a, np.random.default_rng(0)).mean == pytest.approx(0)


def test_skill_is_the_share_of_the_base_error_that_is_gone() -> None:
    base = np.array([1.0, 2.0, 3.0, 4.0])
    found = skill(base / 4, base, np.random.default_rng(0))
    assert found.mean == pytest.approx(0.75)
    assert skill(base, base, np.random.default_rng(0)).mean == 0


def test_bca_is_scipys() -> None:
    values = np.random.default_rng(1).gamma(1.0, 2.0, 25)
    ours = interval(values, rng(), draws=20000)
    theirs = stats.bootstrap((values,), np.mean, n_resamples=20000, method="BCa", rng=rng())
    assert ours.low == pytest.approx(theirs.confidence_interval.low, rel=0.03)
    assert ours.high == pytest.approx(theirs.confidence_interval.high, rel=0.03)
    # Skewed data: the interval reaches further to the long side.
    assert ours.high - ours.mean > ours.mean - ours.low


def test_the_interval_holds_the_truth_about_as_often_as_it_says() -> None:
    draw = np.random.default_rng(2)
    hits = 0
    for _ in range(200):
        i = interval(draw.exponential(1.0, 30), draw, draws=400)
        hits += i.low <= 1.0 <= i.high
    assert 0.87 <= hits / 200 <= 0.99


def test_values_that_are_missing_or_equal() -> None:
    assert interval(np.array([1.0, np.nan, 3.0, 2.0]), rng()).n == 3
    assert np.isnan(interval(np.array([2.0, 2.0, 2.0]), rng()).low)
    assert np.isnan(interval(np.array([]), rng()).mean)


@pytest.mark.parametrize("n", [8, 40])
def test_paired_finds_a_shift_and_does_not_invent_one(n: int) -> None:
    draw = np.random.default_rng(3)
    a = draw.normal(0, 5, n)
    shifted = paired(a, a - 1 + draw.normal(0, 0.3, n), rng())
    assert shifted.p < 0.02
    assert shifted.difference.mean == pytest.approx(-1, abs=0.3)
    assert shifted.wins == 0
    assert paired(a, a + draw.permutation(np.tile([-1.0, 1.0], n // 2)), rng()).p > 0.5


def test_exact_p_by_hand() -> None:
    # Three positive differences: only +++ and --- are as extreme, of eight.
    assert paired(np.zeros(3), np.array([1.0, 2.0, 3.0]), rng()).p == pytest.approx(0.25)


def test_pooled_r2_is_that_of_everything_together_and_its_interval_that_of_scipy() -> None:
    draw = np.random.default_rng(5)
    true = [draw.normal(size=50) * scale for scale in draw.gamma(2, 1, 20)]
    said = [t + draw.normal(size=50) * 0.5 for t in true]
    sums = np.array([dataclasses.astuple(Moments.of(t, p))[:6] for t, p in zip(true, said, strict=True)])
    got = pooled_r2(sums, rng(), draws=8000)
    t, p = np.concatenate(true), np.concatenate(said)
    assert got.mean == pytest.approx(1 - ((t - p) ** 2).sum() / ((t - t.mean()) ** 2).sum())

    def r2(i: np.ndarray) -> float:
        t, p = np.concatenate([true[k] for k in i]), np.concatenate([said[k] for k in i])
        return float(1 - ((t - p) ** 2).sum() / ((t - t.mean()) ** 2).sum())

    theirs = stats.bootstrap(
        (np.arange(20),), r2, n_resamples=2000, method="BCa", vectorized=False, rng=rng()
    )
    assert got.low == pytest.approx(theirs.confidence_interval.low, abs=0.02)
    assert got.high == pytest.approx(theirs.confidence_interval.high, abs=0.02)
    assert np.isnan(pooled_r2(sums[:2], rng()).low)


def test_unequal_lengths() -> None:
    with pytest.raises(UserError, match="3 against 2"):
        paired(np.zeros(3), np.zeros(2), rng())


def test_cosine_warms_up_and_ends_at_zero() -> None:
    assert cosine(0.0) < 0.05
    assert cosine(0.05) == pytest.approx(1)
    assert cosine(0.525) == pytest.approx(0.5)
    assert cosine(1.0) == pytest.approx(0)
