"""The calibrated interval, on videos whose error is drawn: coverage by make, sharpness, where it ends."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import TypeAdapter

from bench.methods.force_interval import NAMES, IntervalTable, VideoEstimates, describe, read_table
from weights.interval_table import Example, fit_table

NETWORKS = {"mono": "a", "stereo": "b"}


def draw(make: int, number: int) -> Example:
    """A press of 24 frames; network and physics disagree by as much as their mean is off, on average."""
    rng = np.random.default_rng([make, number])
    curve = np.sin(np.linspace(0, np.pi, 24)) ** 2 * rng.uniform(2, 40)
    apart = np.exp(rng.uniform(np.log(0.03), np.log(0.6)))
    off = 1 + apart * rng.normal()
    way = np.array([0.6, 0.0, 0.8])
    both = np.stack([off + apart, off - apart])[:, None] * curve + 0.01 * curve.max() * rng.normal(
        size=(2, 24)
    )
    parts = both[..., None] * way
    spread = apart * curve + 0.02 * curve.max()
    video = VideoEstimates(np.abs(both.mean(axis=0)), *parts, spread, 0.02 * curve, 2, float(number % 2))
    return Example(f"make {make}", str(number), video, curve)


def held(table: IntervalTable, one: Example) -> tuple[float, float]:
    low, high = table.bound(one.video, 0.0)
    return float(((low <= one.true_mn) & (one.true_mn <= high)).mean()), float(
        (high - low).mean() / one.true_mn.max()
    )


@pytest.fixture(scope="module")
def table() -> IntervalTable:
    return fit_table([draw(make, k) for make in range(6) for k in range(8)], NETWORKS)


def test_new_videos_are_held_and_widths_follow_the_disagreement(table: IntervalTable) -> None:
    new = [draw(99, k) for k in range(150)]
    shares, widths = np.array([held(table, one) for one in new]).T
    assert 0.85 < shares.mean() < 0.96
    apart = [describe(one.video)[0, list(NAMES).index("overall disagreement")] for one in new]
    order = np.argsort(apart)
    assert widths[order[:30]].mean() < 0.6 * widths[order[-30:]].mean()
    assert table.reached["all"]["score over a constant width's"] < 0.8
    assert 0.82 < table.reached["all"]["holds"] < 0.97


def test_an_uncertain_stiffness_widens_it_in_proportion_to_the_force(table: IntervalTable) -> None:
    video = draw(0, 0).video
    (low, high), (lower, higher) = table.bound(video, 0.0), table.bound(video, 0.5)
    size = video.size_mn
    np.testing.assert_allclose(higher - size, np.hypot(high - size, 1.645 * 0.5 * size))
    assert (lower <= low).all()


def test_a_video_beyond_the_calibration_and_another_network_have_none(table: IntervalTable) -> None:
    video = draw(0, 0).video
    assert table.find_reason(video, "a") == ""
    assert table.find_reason(video, "another")
    assert table.find_reason(replace(video, cameras=1), "a")
    far: NDArray[np.float64] = video.network_mn * 50
    assert "disagreement" in table.find_reason(replace(video, network_mn=far), "a")


def test_the_stored_table_is_read_back(table: IntervalTable) -> None:
    text = json.dumps(asdict(table), allow_nan=False)
    assert TypeAdapter(IntervalTable).validate_python(json.loads(text)) == table
    stored = read_table()
    assert stored.features == tuple(NAMES)
    assert set(stored.by_cameras) == {1, 2}
