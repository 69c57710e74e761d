"""What the stereo figures say of errors that were put in."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from evidence.flow.stereo import Sample, drawn, figures, real_pair


def sample(bias: float, spread: float, deviation: float, count: int = 40_000) -> Sample:
    """Depth motion of 0.5 mm, found with a bias and normal errors of `spread` mm."""
    rng = np.random.default_rng(1)
    true = np.zeros((count, 3), np.float32)
    true[:, 2] = 0.5
    found = true * (1 - bias) + rng.normal(scale=spread, size=true.shape)
    mono = rng.normal(scale=2 * spread, size=(count, 2))
    pressed = np.arange(count) < count // 2
    return Sample("joint", true, found, np.full_like(true, deviation), mono, pressed)


def test_errors_bias_and_scores_are_those_put_in() -> None:
    found = figures([sample(0.0, 0.02, 0.02)])
    assert found["depth_rms_mm"] == pytest.approx(0.02, rel=0.03)
    assert found["pressed_bias"] == pytest.approx(0.0, abs=0.002)
    assert found["across_to_mono"] == pytest.approx(0.5, rel=0.03)
    assert (found["depth_z68"], found["depth_z95"]) == pytest.approx((1.0, 2.0), abs=0.05)
    biased = figures([sample(0.1, 0.001, 0.02)])
    assert biased["pressed_bias"] == pytest.approx(0.1, abs=0.002)
    assert figures([sample(0.0, 0.02, 0.01)])["across_z68"] == pytest.approx(2.0, abs=0.1)


def test_the_page_shows_each_figure_that_was_asked() -> None:
    row = {"data": "stereo-640", "size": "640 x 480", "way": "joint", "cost_ratio": 1.5} | figures(
        [sample(0.0, 0.02, 0.02)]
    )
    page = drawn({"rows": [row], "pair": [{"method": "ours", "off_by_2px": 0.1}]})
    shares = {one.name: one.value for one in page.charts[0].rows}  # type: ignore[union-attr]
    assert len(shares) == 4
    assert max(shares.values()) == pytest.approx(0.75, abs=0.1)
    assert len(page.sections) == 2


def test_a_pair_is_scored_against_its_truth(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    wide = cv2.GaussianBlur(rng.uniform(0, 255, (80, 200, 3)).astype(np.float32), (0, 0), 1.5)
    wide = np.clip(128 + 4 * (wide - 128), 0, 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "left.png"), wide[:, :160])
    cv2.imwrite(str(tmp_path / "right.png"), np.vstack([wide[:40, 2:162], wide[40:, 9:169]]))
    truth = np.where(np.arange(80)[:, None] < 40, 2.0, 9.0) * np.ones((80, 160), np.float32)
    np.savez(tmp_path / "disp.npz", truth)
    right = {row["method"]: row for row in real_pair(tmp_path)}
    assert right["ours"]["off_by_2px"] < 0.1
    assert right["ours"]["median_px"] < 0.1
    np.savez(tmp_path / "disp.npz", truth + 3)
    assert {row["method"]: row for row in real_pair(tmp_path)}["ours"]["off_by_2px"] > 0.9
