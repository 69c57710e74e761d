"""Distances between sets of features: against the definitions, and on sets whose figures are known."""

import numpy as np

from evidence.appearance.features import kernel_distance


def test_the_kernel_distance_is_unbiased_and_grows_with_a_shift() -> None:
    rng = np.random.default_rng(0)
    found = [kernel_distance(*rng.standard_normal((2, 12, 30))) for _ in range(300)]
    assert abs(np.mean(found)) < 3 * np.std(found) / 300**0.5
    shifted = [kernel_distance(one, other + 0.5) for one, other in rng.standard_normal((30, 2, 12, 30))]
    assert np.mean(shifted) > 5 * np.std(found)
