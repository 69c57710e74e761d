from typing import Any

import numpy as np
import pytest
from scipy import stats

from learn.evaluation.metrics import moments
from learn.evaluation.statistics import interval, over_groups, paired, pooled_r2


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_the_interval_has_its_nominal_coverage() -> None:
    draw = np.random.default_rng(2)
    hits = 0
    for _ in range(200):
        i = interval(draw.exponential(1.0, 30), draw, draws=400)
        hits += i.low <= 1.0 <= i.high
    assert 0.87 <= hits / 200 <= 0.99


@pytest.mark.parametrize("n", [8, 40])
def test_paired_detects_a_shift_only_if_there_is_one(n: int) -> None:
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


def test_specimens_are_resampled_whole() -> None:
    values = [1.0] * 10 + [3.0] * 10
    i = over_groups(values, [*"abcde" * 4], rng())
    assert (i.low, i.high) == (2.0, 2.0)  # every specimen has both
    i = over_groups([1.0] * 16 + [6.0] * 4, [*"aaaabbbbccccddddeeee"], rng())
    assert (i.low, i.high) == (1.0, 4.0)  # in 19 of 20 draws at most three of five are the odd specimen
    few = over_groups(values, [*"abcd" * 5], rng())
    assert few.mean == 2
    assert np.isnan([few.low, few.high]).all()


def test_pooled_r2_is_of_all_values_and_its_interval_of_whole_sequences() -> None:
    draw = np.random.default_rng(5)
    true = [draw.normal(size=50) * scale for scale in draw.gamma(2, 1, 20)]
    predicted = [t + draw.normal(size=50) * 0.5 for t in true]
    sums = np.array([moments(t, p) for t, p in zip(true, predicted, strict=True)])
    got = pooled_r2(sums, rng(), draws=8000)
    t, p = np.concatenate(true), np.concatenate(predicted)
    assert got.mean == pytest.approx(1 - ((t - p) ** 2).sum() / ((t - t.mean()) ** 2).sum())

    def r2(i: np.ndarray) -> float:
        t, p = np.concatenate([true[k] for k in i]), np.concatenate([predicted[k] for k in i])
        return float(1 - ((t - p) ** 2).sum() / ((t - t.mean()) ** 2).sum())

    how: dict[str, Any] = {"n_resamples": 2000, "method": "BCa", "vectorized": False, "rng": rng()}
    theirs = stats.bootstrap((np.arange(20),), r2, **how).confidence_interval
    assert (got.low, got.high) == pytest.approx((theirs.low, theirs.high), abs=0.02)
    assert np.isnan(pooled_r2(sums[:2], rng()).low)
    still = np.array([moments(np.zeros(4), np.ones(4))] * 4)
    assert np.isnan(pooled_r2(still, rng()).mean), "R² needs force"
