"""What is solved here in closed form, against scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.covariance import LedoitWolf
from sklearn.linear_model import Ridge

from learn.uncertainty.error_model import fit_error_model
from learn.uncertainty.out_of_distribution import shrunk_covariance


@pytest.mark.parametrize("count", [12, 400])
def test_the_covariance_is_ledoits_and_wolfs(count: int) -> None:
    rng = np.random.default_rng(3)
    samples = rng.normal(size=(count, 8)) @ rng.normal(size=(8, 8)) + 5
    assert shrunk_covariance(samples) == pytest.approx(LedoitWolf().fit(samples).covariance_, rel=1e-9)


def test_the_scale_is_a_ridges() -> None:
    rng = np.random.default_rng(4)
    features = rng.normal(size=(60, 3)) * [1, 10, 0.1] + [0, 5, 2]
    error, weight = np.exp(features[:, 0] + rng.normal(size=60)), rng.uniform(0.2, 2, 60)
    rule = fit_error_model(features, error, weight, 0.1)
    spread = features.std(0)
    theirs = Ridge(alpha=1.0).fit(
        features / spread, np.log(error + 0.1), sample_weight=weight / weight.mean()
    )
    assert rule.slopes == pytest.approx(theirs.coef_ / spread, rel=1e-6)
    assert rule.intercept == pytest.approx(float(theirs.intercept_), rel=1e-6)
