"""A network's answer to no motion is taken off its answers, as a sensor's zero is."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bench.follow import Scene
from bench.methods import Model


@pytest.mark.parametrize("vector", [True, False])
def test_answer_to_the_rest_frame_is_the_zero(vector: bool) -> None:
    def predictor(flow: np.ndarray, tissue: object, scale: float, young: object, sure: object) -> object:
        total = 2.0 + float(flow.sum())
        return SimpleNamespace(
            young_kpa=1.0, force_mn=np.array([total, 1.0, 0.0]) if vector else None, total_force_mn=total
        )

    model = Model.__new__(Model)
    model.predictor, model._rest = predictor, None  # type: ignore[assignment]
    scene = Scene(np.ones((4, 4), bool), 0.1, 1.0)
    moved, sure = np.zeros((4, 4, 2), np.float32), np.ones((4, 4), np.float32)
    assert model(moved, sure, scene, False).size_mn == 0
    moved[0, 0, 0] = 3
    assert model(moved, sure, scene, False).size_mn == pytest.approx(3)
    moved[0, 0, 0] = -1
    assert model(moved, sure, scene, False).force_mn[0] == (-1 if vector else 0)
