"""Distances between sets of features: against the definitions, and on sets whose figures are known."""

import numpy as np

from evidence.appearance.features import apart, kernel_distance, neighbourhoods


def test_the_kernel_distance_is_unbiased_and_grows_with_a_shift() -> None:
    rng = np.random.default_rng(0)
    found = [kernel_distance(*rng.standard_normal((2, 12, 30))) for _ in range(300)]
    assert abs(np.mean(found)) < 3 * np.std(found) / 300**0.5
    shifted = [kernel_distance(one, other + 0.5) for one, other in rng.standard_normal((30, 2, 12, 30))]
    assert np.mean(shifted) > 5 * np.std(found)


def test_neighbours_of_known_points_are_counted() -> None:
    line = np.arange(12.0)[:, None]
    assert neighbourhoods(line, line + 0.1) == {"precision": 1, "recall": 1, "coverage": 1}
    near = neighbourhoods(line, np.repeat([[0.0]], 12, axis=0))
    assert near["coverage"] == 3 / 12  # fifth neighbours of 0, 1, 2, 3 are 5, 4, 3, 3 away
    assert near["precision"] == 1
    assert apart(np.array([[0.0, 0], [100, 100], [128, 0], [0, 130]])) == [0, 2, 3]
