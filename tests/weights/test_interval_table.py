"""The calibrated interval, on videos whose error is drawn: coverage by make, sharpness, where it ends."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from pydantic import TypeAdapter

from bench.methods.force_interval import (
    NAMES,
    IntervalTable,
    VideoEstimates,
    bound,
    describe,
    gather,
    read_table,
)
from bench.methods.force_mixture import ForceMixture
from bench.methods.method_interface import ForceEstimate
from weights.interval_table import Example, check_table, fit_table


def draw(make: int, number: int) -> Example:
    """A press of 24 frames, whose estimate is off by as much as the posterior is wide, on average."""
    rng = np.random.default_rng([make, number])
    curve = np.sin(np.linspace(0, np.pi, 24)) ** 2 * rng.uniform(2, 40)
    relative_error = np.exp(rng.uniform(np.log(0.03), np.log(0.6)))
    size = np.abs((1 + relative_error * rng.normal()) * curve + 0.01 * curve.max() * rng.normal(size=24))
    video = VideoEstimates(
        size, relative_error * curve + 0.02 * curve.max(), 0.02 * curve, 2, float(number % 2)
    )
    return Example(f"make {make}", str(number), video, curve)


def measure_coverage(table: IntervalTable, example: Example) -> tuple[float, float]:
    low, high = table.bound(example.video, 0.0)
    return float(((low <= example.true_mn) & (example.true_mn <= high)).mean()), float(
        (high - low).mean() / example.true_mn.max()
    )


@pytest.fixture(scope="module")
def table() -> IntervalTable:
    return fit_table([draw(make, k) for make in range(6) for k in range(8)])


def test_new_videos_are_held_and_widths_follow_the_posterior(table: IntervalTable) -> None:
    new = [draw(99, k) for k in range(150)]
    shares, widths = np.array([measure_coverage(table, example) for example in new]).T
    assert 0.85 < shares.mean() < 0.96
    spread = [describe(example.video)[0, list(NAMES).index("overall spread")] for example in new]
    order = np.argsort(spread)
    assert widths[order[:30]].mean() < 0.6 * widths[order[-30:]].mean()
    assert table.reached["all"]["score over a constant width's"] < 0.8
    assert 0.82 < table.reached["all"]["holds"] < 0.97


def test_a_table_checked_on_another_motion_states_what_it_holds_there(table: IntervalTable) -> None:
    new = [draw(99, k) for k in range(60)]
    checked = check_table(replace(table, flow="tvl1 of before"), new)
    assert checked.flow == table.flow
    assert checked.by_cameras == table.by_cameras
    expected = np.mean([measure_coverage(table, example) for example in new], axis=0)
    row = checked.checked["all"]
    np.testing.assert_allclose([row["holds"], row["width"]], expected)
    halved = [replace(example, true_mn=0.5 * example.true_mn) for example in new]
    assert check_table(table, halved).checked["all"]["holds"] < 0.5


def test_an_uncertain_stiffness_widens_it_in_proportion_to_the_force(table: IntervalTable) -> None:
    video = draw(0, 0).video
    (low, high), (lower, higher) = table.bound(video, 0.0), table.bound(video, 0.5)
    size = video.size_mn
    np.testing.assert_allclose(higher - size, np.hypot(high - size, 1.645 * 0.5 * size))
    assert (lower <= low).all()


def test_a_video_beyond_the_calibration_and_another_motion_have_none_but_a_reason(
    table: IntervalTable,
) -> None:
    video = draw(0, 0).video
    assert table.find_reason(video, table.flow) == ""
    for other in ("", "dis 1"):
        assert table.find_reason(video, other)
    assert table.find_reason(replace(video, cameras=1), table.flow)
    assert "spread" in table.find_reason(replace(video, spread_mn=50 * video.spread_mn), table.flow)


def test_estimates_get_ends_or_none() -> None:
    curve = np.sin(np.linspace(0, np.pi, 24)) ** 2
    mixtures = [ForceMixture(np.ones(1), c * np.eye(3)[:1], 0.04 * c**2 * np.eye(3)[None]) for c in 5 * curve]
    finite_estimates = [
        ForceEstimate(force.mean, low_mn=0.0, high_mn=9.0, likely=force) for force in mixtures
    ]
    video = gather(finite_estimates, 0.05 * curve, 2, 0.5)
    np.testing.assert_allclose(video.spread_mn, 0.2 * np.sqrt(3) * 5 * curve, atol=1e-6)
    intervals, reason = bound(finite_estimates, video, 0.0, read_table().flow)
    assert reason == ""
    assert all(estimate.low_mn <= estimate.size_mn <= estimate.high_mn != 9.0 for estimate in intervals)
    nan_estimates = [*finite_estimates[:-1], replace(finite_estimates[-1], low_mn=math.nan, high_mn=math.nan)]
    for estimates, flow in ((finite_estimates, "dis 1"), (nan_estimates, read_table().flow)):
        intervals, reason = bound(estimates, video, 0.0, flow)
        assert reason
        assert np.isnan([estimate.high_mn for estimate in intervals]).all()
        assert [estimate.size_mn for estimate in intervals] == [
            estimate.size_mn for estimate in finite_estimates
        ]


def test_the_stored_table_is_read_back(table: IntervalTable) -> None:
    text = json.dumps(asdict(table), allow_nan=False)
    assert TypeAdapter(IntervalTable).validate_python(json.loads(text)) == table
    stored = read_table()
    assert stored.features == tuple(NAMES)
    assert set(stored.by_cameras) == {1, 2}
