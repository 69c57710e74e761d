"""Coverage of hierarchical split conformal prediction on drawn scores."""

import math

import numpy as np
import pytest

from learn.uncertainty import conformal

DRAWS = 2000


def coverage(units: int, frames: int, frame_noise: float, level: float, seed: int) -> tuple[float, float]:
    """Share of a new unit's frames within the quantile, mean over draws, and its standard error.

    A frame's score is the size of its unit's error plus `frame_noise` times one of its own.
    """
    rng, shares = np.random.default_rng(seed), np.empty(DRAWS)
    for k in range(DRAWS):
        errors = rng.normal(size=(units + 1, 1)) + frame_noise * rng.normal(size=(units + 1, frames))
        scores = np.abs(errors)
        bound = conformal.quantile(list(scores[:-1]), level)
        shares[k] = (scores[-1] <= bound).mean()
    return float(shares.mean()), float(shares.std() / math.sqrt(DRAWS))


@pytest.mark.parametrize(("units", "level"), [(9, 0.9), (12, 0.9), (19, 0.9), (24, 0.68)])
def test_coverage_of_constant_units_is_that_of_ranks(units: int, level: float) -> None:
    share, error = coverage(units, 6, 0.0, level, seed=units)
    exact = math.ceil((units + 1) * level - 1e-9) / (units + 1)
    assert exact >= level
    assert share == pytest.approx(exact, abs=3.5 * error)


@pytest.mark.parametrize("frame_noise", [0.05, 0.3, 3.0])
def test_coverage_does_not_depend_on_the_correlation_within_units(frame_noise: float) -> None:
    share, error = coverage(19, 6, frame_noise, 0.9, seed=1)
    assert share >= 0.9 - 3 * error
    assert share <= 0.9 + 1 / 20 + 3 * error


def test_units_weigh_equally_whatever_their_length() -> None:
    rng, shares, pooled_shares = np.random.default_rng(3), [], []
    for _ in range(1000):
        is_hard = rng.random(21) < 0.3
        scores = [np.abs(rng.normal(size=4 if h else 60)) * (10 if h else 1) for h in is_hard]
        shares.append((scores[-1] <= conformal.quantile(scores[:-1], 0.9)).mean())
        pooled_shares.append((scores[-1] <= np.quantile(np.concatenate(scores[:-1]), 0.9)).mean())
    assert np.mean(shares) >= 0.9 - 3 * np.std(shares) / math.sqrt(len(shares))
    assert np.mean(pooled_shares) < 0.82


@pytest.mark.parametrize(("level", "least"), [(0.9, 9), (0.68, 3), (0.5, 1), (0.95, 19)])
def test_too_few_units_have_no_finite_bound(level: float, least: int) -> None:
    assert conformal.least_units(level) == least
    scores = [np.array([1.0, 2.0])] * least
    assert conformal.quantile(scores, level) == 2.0
    assert math.isinf(conformal.quantile(scores[1:], level)) if least > 1 else True
