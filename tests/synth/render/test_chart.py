"""The square that maps are painted over: as large as the surface, and nowhere folded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synth.render.anatomy.chart import Chart, unroll

Floats = NDArray[np.float64]
PLAN, RADIUS = 34.0, 14.0


def folds(at: Floats) -> Floats:
    """Parallel folds of 12 mm at 30 degrees, as steep as 46 degrees: they unroll exactly."""
    across = at @ np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    return np.asarray(2 * np.cos(2 * np.pi / 12 * across))


def singular(chart: Chart) -> Floats:
    """(n, 2) singular values of the map from the chart to the surface, over the middle of the disc."""
    axis = np.linspace(-8, 8, 60)
    at, step = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2), 0.05
    sides = np.array([[step, 0], [0, step]])
    on = np.stack([chart.at(at + side) - chart.at(at - side) for side in sides], axis=-1)
    rise = np.stack([folds(at + side) - folds(at - side) for side in sides], axis=-1)
    up = np.concatenate([np.broadcast_to(2 * sides, (len(at), 2, 2)), rise[:, None]], axis=1)
    assert (np.linalg.det(on) > 0).all()
    return np.asarray(np.linalg.svd(up @ np.linalg.inv(on), compute_uv=False))


def test_what_can_be_unrolled_keeps_its_lengths() -> None:
    stretch = singular(unroll(folds, PLAN, RADIUS))
    assert np.quantile(stretch[:, 0], 0.95) < 1.05
    assert np.quantile(stretch[:, 1], 0.05) > 0.95
    plan = singular(Chart(np.zeros((4, 4, 2), np.float32), PLAN, PLAN))
    assert np.quantile(plan[:, 0], 0.95) > 1.3


def test_a_place_is_found_again() -> None:
    chart = unroll(folds, PLAN, RADIUS)
    there = chart.at(chart.places(64)).reshape(64, 64, 2)
    middle = ((np.arange(64) + 0.5) / 64 - 0.5) * chart.extent_mm
    assert np.abs(there - np.stack(np.meshgrid(middle, middle), axis=-1)).max() < 0.05
    np.testing.assert_array_equal(chart.shift, unroll(folds, PLAN, RADIUS).shift)


def test_what_is_nearly_flat_stays_its_plan() -> None:
    chart = unroll(lambda at: 0.2 * folds(at), PLAN, RADIUS)
    assert chart.extent_mm == PLAN
    assert not chart.shift.any()
