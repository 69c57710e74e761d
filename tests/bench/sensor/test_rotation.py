"""The sensor's rotation, from the closed form of a half-space (Cerruti and Boussinesq), off centre."""

import numpy as np
import pytest
from numpy.typing import NDArray
from phantom import displacement
from scipy.spatial.transform import Rotation

from bench.sensor.rotation import find_rotation

Floats = NDArray[np.float64]


def _simulate_press(seed: int, flat: float = 0.6) -> tuple[Floats, Floats, Floats, Rotation]:
    """Motion (T, P, 2), visibility (T, P), the sensor's force (T, 3), and the rotation between."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-15, 16, 2.0), np.arange(-11, 12, 2.0))
    contact = rng.uniform(-4, 4, 2)
    unit = np.stack([displacement(x - contact[0], y - contact[1], axis, 2.0) for axis in np.eye(3)])
    time = np.arange(120) / 10
    waves = rng.uniform(0.2, 0.6, (3, 1)) * time + rng.uniform(0, 1, (3, 1))
    camera = 60 * np.sin(2 * np.pi * waves).T * [flat, flat, 1.0]
    motion = np.einsum("tk,krcj->trcj", camera, unit).reshape(len(time), -1, 2)
    motion += rng.normal(0, 0.05 * np.abs(motion).max(), motion.shape)
    turn = Rotation.random(random_state=seed)
    return motion, np.ones(motion.shape[:2]), turn.inv().apply(camera), turn


@pytest.mark.parametrize("videos", [4, pytest.param(12, marks=pytest.mark.trial)])
def test_rotation_is_found_within_its_stated_error(videos: int) -> None:
    errors, deviations = [], []
    for seed in range(videos):
        motion, visible, force, turn = _simulate_press(seed)
        rotation = find_rotation(motion, visible, force)
        assert rotation.refused == ""
        errors.append(np.degrees((Rotation.from_matrix(rotation.rows) * turn.inv()).magnitude()))
        deviations.append(rotation.deviation_deg)
    assert max(errors) < 1
    assert max(deviations) < 3
    assert max(np.array(errors) / deviations) < 2


def test_undetermined_rotations_are_refused() -> None:
    motion, visible, force, _ = _simulate_press(1)
    assert "needed" in find_rotation(motion[:10], visible[:10], force[:10]).refused
    assert "plane" in find_rotation(motion, visible, force * [1, 1, 0]).refused
    assert "nothing moves" in find_rotation(0 * motion, visible, force).refused
    other = np.random.default_rng(5).normal(size=force.shape)
    assert "follows the force" in find_rotation(motion, visible, other).refused
