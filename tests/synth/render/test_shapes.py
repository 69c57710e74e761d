"""Shapes: the chart of the surface, trees of vessels, instruments."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from synth.job.schema import AnatomySection
from synth.render import instrument
from synth.render.anatomy import surface
from synth.render.anatomy.chart import Chart, places, unroll
from synth.render.anatomy.tree import murray
from synth.render.appearance.reflection import Theatre
from synth.sequence import scenario

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
    there = chart.at(places(chart, 64)).reshape(64, 64, 2)
    middle = ((np.arange(64) + 0.5) / 64 - 0.5) * chart.extent_mm
    assert np.abs(there - np.stack(np.meshgrid(middle, middle), axis=-1)).max() < 0.05
    np.testing.assert_array_equal(chart.shift, unroll(folds, PLAN, RADIUS).shift)


def test_what_is_nearly_flat_stays_its_plan() -> None:
    chart = unroll(lambda at: 0.2 * folds(at), PLAN, RADIUS)
    assert chart.extent_mm == PLAN
    assert not chart.shift.any()


def test_cubes_of_radii_add_up() -> None:
    parent = np.array([-1, 0, 1, 1, 3, 3])
    radius = murray(parent, leaf=0.1)
    assert radius[0] == pytest.approx((3 * 0.1**3) ** (1 / 3))
    assert radius[3] == pytest.approx((2 * 0.1**3) ** (1 / 3))


@pytest.mark.slow
@pytest.mark.parametrize("radius_mm", [4.0, 30.0])
def test_every_anatomy_grows(radius_mm: float) -> None:
    """Small openings have trunks so short that none of their nodes may be drawn to sprout."""
    section = AnatomySection.model_validate({"craniotomy": {"radius_mm": radius_mm}, "vertices": 900})
    for seed in range(1 if radius_mm > 5 else 4):
        made = surface.grow(scenario.draw_relief(section, np.random.default_rng(seed)), section)
        assert np.isfinite(made.vertices).all()


def test_every_twig_has_a_parent() -> None:
    section = AnatomySection()
    made = surface.grow(scenario.draw_relief(section, np.random.default_rng(3)), section)
    for tree in (made.vessels.arteries, made.vessels.veins, made.vessels.deep):
        child = np.flatnonzero(tree.parent >= 0)
        assert (tree.parent[child] < child).all()
        assert (tree.parent < 0).sum() <= 7, "roots are the trunks' alone"
        longest = np.linalg.norm(tree.nodes[child] - tree.nodes[tree.parent[child]], axis=1).max()
        assert longest < 0.8, "a twig that starts away from what it springs from"
    arteries = made.vessels.arteries
    assert 0.02 < np.quantile(arteries.radius, 0.3) < 0.05  # arterioles of 60-100 um


TIPS = np.array([[-1.0, 0.5, 2.0], [1.0, 0.5, 2.0]])
SHAFTS = np.array([[0.3, 0.2, 0.9], [0.3, 0.2, 0.9]])
DARK = Theatre(np.zeros((2, 2, 3), np.float32), 30.0, (), np.zeros(3), np.array([0, 0, 300.0]), seed=0)


@pytest.mark.parametrize("kind", instrument.SHAPES)
def test_an_instrument_ends_at_its_tips(kind: str) -> None:
    made = instrument.build([(kind, 2.5)], DARK, np.random.default_rng(0))
    assert made is not None
    points, _ = made.pose(TIPS, SHAFTS)
    assert np.isfinite(points).all()
    assert made.faces.max() == len(points) - 1
    goals = TIPS if kind in ("forceps", "bayonet") else TIPS.mean(axis=0, keepdims=True)
    for goal in goals:
        assert np.linalg.norm(points - goal, axis=1).min() < 1.3
    # Nothing reaches past the tips, and the rest is on the hand's side.
    along = (points - TIPS.mean(axis=0)) @ (SHAFTS[0] / np.linalg.norm(SHAFTS[0]))
    assert along.min() > -0.4  # the tips are apart, also along the shaft
    assert 100 < along.max() < 120
    assert trimesh.Trimesh(points, made.faces).volume > 50, "faces turn outwards"
