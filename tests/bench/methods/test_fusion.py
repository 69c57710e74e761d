"""Network and physics as one answer, against closed forms of Gaussians and draws of what both state."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.methods.force_mixture import ForceMixture
from bench.methods.fusion import Fusion
from bench.methods.protocol import ForceEstimate, MethodContext

Floats = NDArray[np.float64]
SCENE = MethodContext(np.ones((4, 4), bool), 0.1, 1.0)
CAUTION = 1.5  # times what the network states


def estimate(forces: list[Floats], deviations: list[float], weights: list[float]) -> ForceEstimate:
    mixture = ForceMixture(
        np.array(weights), np.array(forces), np.array([np.eye(3) * one**2 for one in deviations])
    )
    return ForceEstimate(mixture.mean, likely=mixture)


def together(network: ForceEstimate, physics: ForceEstimate) -> tuple[ForceEstimate, Fusion]:
    method = Fusion("network", "physics")
    return method.fuse([{"network": network, "physics": physics}], SCENE, 2)[0], method


def test_two_gaussians_weigh_as_their_precisions() -> None:
    a, b = np.array([3.0, 0.0, 1.0]), np.array([1.0, 2.0, 0.0])
    physics = estimate([b], [0.5], [1.0])
    found, _ = together(estimate([a], [1 / CAUTION], [1.0]), physics)
    np.testing.assert_allclose(found.force_mn, (a + 4 * b) / 5)
    assert physics.likely is not None
    np.testing.assert_allclose(physics.likely.observe(a, np.eye(3)).covariance[0], np.eye(3) / 5, atol=1e-12)


def test_what_the_network_speaks_against_fades() -> None:
    near, far = np.array([2.0, 0.0, 0.0]), np.array([5.0, 0.0, 0.0])
    physics = estimate([near, far], [0.8, 0.8], [0.3, 0.7]).likely
    assert physics is not None
    odds = 0.7 / 0.3 * np.exp(-(3.0**2) / 2)  # variances add up to 1
    found = physics.observe(near, 0.36 * np.eye(3))
    np.testing.assert_allclose(found.weight, [1 / (1 + odds), odds / (1 + odds)])


def test_without_a_stated_error_the_network_answers_alone() -> None:
    network, physics = estimate([np.ones(3)], [1.0], [1.0]), ForceEstimate(np.zeros(3))
    np.testing.assert_array_equal(together(network, physics)[0].force_mn, network.force_mn)


def test_ninety_of_a_hundred_draws_lie_within() -> None:
    rng, inside, count = np.random.default_rng(0), 0, 400
    for _ in range(count):
        true = rng.normal(size=3) * 5
        factor = np.exp(0.3 * rng.normal())
        said = [true * factor + deviation * rng.normal(size=3) for deviation in (1.0, 0.7)]
        found, _ = together(estimate([said[0]], [1 / CAUTION], [1.0]), estimate([said[1]], [0.7], [1.0]))
        inside += found.low_mn <= np.linalg.norm(true) <= found.high_mn
    assert inside / count == pytest.approx(0.9, abs=0.05)


def test_what_a_press_leaves_behind_may_be_no_force() -> None:
    said = [estimate([np.array([size, 0.0, 0.0])], [0.01], [1.0]) for size in (10.0, 0.3, 1.0)]
    found = Fusion("network", "physics").fuse([{"network": o, "physics": o} for o in said], SCENE, 1)
    assert [one.low_mn > 0 for one in found] == [True, False, True]
