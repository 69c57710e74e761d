"""Fusion of network and physics, against closed forms of Gaussians and draws from stated errors."""

import numpy as np
from numpy.typing import NDArray

from bench.methods.force_fusion import Fusion
from bench.methods.force_mixture import ForceMixture
from bench.methods.method_interface import ForceEstimate, MethodContext

Floats = NDArray[np.float64]
SCENE = MethodContext(np.ones((4, 4), bool), 0.1, 1.0)
CAUTION = 1.5  # factor of the network's stated deviation


def estimate(forces: list[Floats], deviations: list[float], weights: list[float]) -> ForceEstimate:
    covariance = np.square(deviations)[:, None, None] * np.eye(3)
    mixture = ForceMixture(np.array(weights), np.array(forces), covariance)
    return ForceEstimate(mixture.mean, low_mn=0.0, high_mn=20.0, likely=mixture)


def fuse_frame(network: ForceEstimate, physics: ForceEstimate) -> ForceEstimate:
    return Fusion("network", "physics").fuse([{"network": network, "physics": physics}], SCENE, 2)[0]


def test_gaussians_are_weighted_by_their_precisions_and_the_network_alone_without_a_stated_error() -> None:
    a, b = np.array([3.0, 0.0, 1.0]), np.array([1.0, 2.0, 0.0])
    physics = estimate([b], [0.5], [1.0])
    fused = fuse_frame(estimate([a], [1 / CAUTION], [1.0]), physics)
    np.testing.assert_allclose(fused.force_mn, (a + 4 * b) / 5)
    np.testing.assert_allclose(physics.likely.observe(a, np.eye(3)).covariance[0], np.eye(3) / 5, atol=1e-12)
    network_only = fuse_frame(estimate([a], [1.0], [1.0]), ForceEstimate(b))
    np.testing.assert_array_equal(network_only.force_mn, a)


def test_weights_are_told_only_where_frames_are_fused() -> None:
    network, physics = (estimate([np.full(3, size)], [0.5], [1.0]) for size in (3.0, 1.0))
    for part, is_fused in ((physics, True), (ForceEstimate(np.ones(3)), False)):
        fusion = Fusion("network", "physics")
        fusion.fuse([{"network": network, "physics": part}], SCENE, 2)
        assert bool(fusion.notes) == is_fused
        assert bool(fusion.warnings) != is_fused


def test_components_that_contradict_the_network_lose_weight() -> None:
    near_force, far_force = np.array([2.0, 0.0, 0.0]), np.array([5.0, 0.0, 0.0])
    physics = estimate([near_force, far_force], [0.8, 0.8], [0.3, 0.7]).likely
    odds = 0.7 / 0.3 * np.exp(-(3.0**2) / 2)  # variances add up to 1
    mixture = physics.observe(near_force, 0.36 * np.eye(3))
    np.testing.assert_allclose(mixture.weight, [1 / (1 + odds), odds / (1 + odds)])


def test_the_magnitude_counts_the_component_that_the_motion_does_not_show() -> None:
    even = ForceMixture(np.ones(1), np.zeros((1, 3)), 4.0 * np.eye(3)[None])
    np.testing.assert_allclose(even.mean_size, 2 * np.sqrt(8 / np.pi), rtol=0.04)  # Maxwell's distribution
    z = np.linspace(-8, 8, 4001)
    hidden = np.trapezoid(np.hypot(3, 4 * z) * np.exp(-(z**2) / 2), z) / np.sqrt(2 * np.pi)
    flat = ForceMixture(np.ones(1), np.array([[3.0, 0, 0]]), np.diag([1e-4, 1e-4, 16.0])[None])
    np.testing.assert_allclose(flat.mean_size, hidden, rtol=0.04)
    network = estimate([np.array([3.0, 0, 0])], [1e-3], [1.0])
    frames = [{"network": network, "physics": ForceEstimate(flat.mean, likely=flat)}]
    for cameras, size in ((1, hidden), (2, 3.0)):
        (fused,) = Fusion("network", "physics").fuse(frames, SCENE, cameras)
        np.testing.assert_allclose(np.linalg.norm(fused.force_mn), 3.0, rtol=0.01)
        np.testing.assert_allclose(fused.size_mn, size, rtol=0.04)
