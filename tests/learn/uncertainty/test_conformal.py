"""Coverage of hierarchical split conformal prediction on drawn scores."""

import math

import numpy as np
import pytest

from learn.uncertainty import conformal

DRAWS = 2000


def coverage(units: int, frames: int, own: float, level: float, seed: int) -> tuple[float, float]:
    """Share of a new unit's frames within the quantile, mean over draws, and its standard error.

    A frame's score is the size of its unit's error plus `own` times one of its own.
    """
    rng, held = np.random.default_rng(seed), np.empty(DRAWS)
    for k in range(DRAWS):
        errors = rng.normal(size=(units + 1, 1)) + own * rng.normal(size=(units + 1, frames))
        scores = np.abs(errors)
        bound = conformal.quantile(list(scores[:-1]), level)
        held[k] = (scores[-1] <= bound).mean()
    return float(held.mean()), float(held.std() / math.sqrt(DRAWS))


@pytest.mark.parametrize(("units", "level"), [(9, 0.9), (12, 0.9), (19, 0.9), (24, 0.68)])
def test_coverage_of_constant_units_is_that_of_ranks(units: int, level: float) -> None:
    found, error = coverage(units, 6, 0.0, level, seed=units)
    exact = math.ceil((units + 1) * level - 1e-9) / (units + 1)
    assert exact >= level
    assert found == pytest.approx(exact, abs=3.5 * error)


@pytest.mark.parametrize("own", [0.05, 0.3, 3.0])
def test_coverage_does_not_depend_on_the_correlation_within_units(own: float) -> None:
    found, error = coverage(19, 6, own, 0.9, seed=1)
    assert found >= 0.9 - 3 * error
    assert found <= 0.9 + 1 / 20 + 3 * error


def test_units_weigh_equally_whatever_their_length() -> None:
    rng, held, pooled = np.random.default_rng(3), [], []
    for _ in range(1000):
        hard = rng.random(21) < 0.3
        scores = [np.abs(rng.normal(size=4 if h else 60)) * (10 if h else 1) for h in hard]
        held.append((scores[-1] <= conformal.quantile(scores[:-1], 0.9)).mean())
        pooled.append((scores[-1] <= np.quantile(np.concatenate(scores[:-1]), 0.9)).mean())
    assert np.mean(held) >= 0.9 - 3 * np.std(held) / math.sqrt(len(held))
    assert np.mean(pooled) < 0.82


@pytest.mark.parametrize(("level", "least"), [(0.9, 9), (0.68, 3), (0.5, 1), (0.95, 19)])
def test_too_few_units_have_no_finite_bound(level: float, least: int) -> None:
    assert conformal.least_units(level) == least
    scores = [np.array([1.0, 2.0])] * least
    assert conformal.quantile(scores, level) == 2.0
    assert math.isinf(conformal.quantile(scores[1:], level)) if least > 1 else True
