"""A network's estimate at rest is subtracted from its estimates, like a sensor's tare."""

from __future__ import annotations

import numpy as np
import pytest

from bench.methods.network import Model
from bench.methods.protocol import FrameMotion, MethodContext
from learn.data.grid import Grid, GridView
from learn.inference.predict import ForceMap


@pytest.mark.parametrize("young_kpa", [2.0, None])
@pytest.mark.parametrize("vector", [True, False])
def test_the_rest_frame_is_the_zero_and_unknown_tissue_has_1_kpa(
    vector: bool, young_kpa: float | None
) -> None:
    tissue, typical = np.ones((4, 4), bool), 5.0
    view = GridView(tissue, 0.1, Grid(16))

    def predictor(
        flow: np.ndarray, where: object, scale: float, young: float | None, *more: object, **place: object
    ) -> ForceMap:
        """Total force of 2 mN and 1 mN a pixel of motion, for each kPa."""
        per_kpa = np.array([2.0 + float(flow.sum()), 1.0, 0.0])[: 3 if vector else 1]
        density = np.zeros((len(per_kpa), 16, 16), np.float32)
        density[:, 8, 8] = (young or typical) * per_kpa / Grid(16).pitch_mm ** 2
        return ForceMap(density, Grid(16), young or typical, young is not None, view)

    predictor.grid = Grid(16)  # type: ignore[attr-defined]
    model = Model.__new__(Model)
    model.predictor, model._estimator = predictor, None  # type: ignore[assignment]
    scene = MethodContext(tissue, 0.1, young_kpa)
    frame = FrameMotion(np.zeros((4, 4, 2), np.float32), np.ones((4, 4), np.float32))
    young = young_kpa or 1.0
    assert model(frame, scene, False).size_mn == 0
    frame.flow[0, 0, 0] = 3
    assert model(frame, scene, False).size_mn == pytest.approx(3 * young)
    frame.flow[0, 0, 0] = -1
    assert model(frame, scene, False).force_mn[0] == pytest.approx(-young if vector else 0)
