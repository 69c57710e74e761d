"""The sensor's rotation, from the closed form of a half-space (Cerruti and Boussinesq), off centre."""

import numpy as np
import pytest
from numpy.typing import NDArray
from phantom import displacement
from scipy.spatial.transform import Rotation

from bench.sensor.rotation import find_rotation

Floats = NDArray[np.float64]


def _pressed(seed: int, flat: float = 0.6) -> tuple[Floats, Floats, Floats, Rotation]:
    """Motion (T, P, 2), visibility (T, P), the sensor's force (T, 3), and the rotation between."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-15, 16, 2.0), np.arange(-11, 12, 2.0))
    at = rng.uniform(-4, 4, 2)
    unit = np.stack([displacement(x - at[0], y - at[1], one, 2.0) for one in np.eye(3)])
    time = np.arange(120) / 10
    waves = rng.uniform(0.2, 0.6, (3, 1)) * time + rng.uniform(0, 1, (3, 1))
    camera = 60 * np.sin(2 * np.pi * waves).T * [flat, flat, 1.0]
    moved = np.einsum("tk,krcj->trcj", camera, unit).reshape(len(time), -1, 2)
    moved += rng.normal(0, 0.05 * np.abs(moved).max(), moved.shape)
    turn = Rotation.random(random_state=seed)
    return moved, np.ones(moved.shape[:2]), turn.inv().apply(camera), turn


@pytest.mark.parametrize("videos", [4, pytest.param(12, marks=pytest.mark.trial)])
def test_rotation_is_found_within_its_stated_error(videos: int) -> None:
    errors, deviations = [], []
    for seed in range(videos):
        moved, visible, force, turn = _pressed(seed)
        found = find_rotation(moved, visible, force)
        assert found.refused == ""
        errors.append(np.degrees((Rotation.from_matrix(found.rows) * turn.inv()).magnitude()))
        deviations.append(found.deviation_deg)
    assert max(errors) < 1
    assert max(deviations) < 3
    assert max(np.array(errors) / deviations) < 2


def test_undetermined_rotations_are_refused() -> None:
    moved, visible, force, _ = _pressed(1)
    assert "needed" in find_rotation(moved[:10], visible[:10], force[:10]).refused
    assert "plane" in find_rotation(moved, visible, force * [1, 1, 0]).refused
    assert "nothing moves" in find_rotation(0 * moved, visible, force).refused
    other = np.random.default_rng(5).normal(size=force.shape)
    assert "follows the force" in find_rotation(moved, visible, other).refused
