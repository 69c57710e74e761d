"""The gap's arithmetic on errors that are known, and the noise model on noise that is."""

from __future__ import annotations

import numpy as np
import pytest

from evidence.gap import gap


def test_share_closed_by_hand() -> None:
    rng = np.random.default_rng(0)
    base = rng.uniform(0.9, 1.1, 30)
    got = gap.closed(10 * base, 6 * base, 2 * base, rng)
    assert got.share == pytest.approx(4 / 8, rel=1e-9)
    assert got.interval == pytest.approx((0.5, 0.5), abs=1e-6)  # all in proportion: pairs leave no doubt
    assert got.undefined == ""


def test_no_gap_is_undefined_and_says_so() -> None:
    rng = np.random.default_rng(0)
    errors = rng.normal(5, 2, 20)
    got = gap.closed(errors, errors - 1, errors + 0.3 * rng.normal(size=20), rng)
    assert np.isnan(got.share)
    assert "touches zero" in got.undefined


def test_noise_is_fitted_and_made_alike() -> None:
    rng = np.random.default_rng(1)
    mask = np.zeros((48, 48), np.float32)
    mask[6:-6, 6:-6] = 1
    ideal = [np.cumsum(rng.normal(size=(6, 2, 1, 1)), axis=0).astype(np.float32) * mask for _ in range(8)]
    true = gap.Noise(0.9, 0.12, 2.0)
    found = gap.fit_noise(ideal, [true.add(i, mask, rng) for i in ideal], [mask] * 8)
    assert found.gain == pytest.approx(0.9, abs=0.02)
    assert found.sigma_mm == pytest.approx(0.12, rel=0.1)
    assert found.reach_cells == pytest.approx(2.0, rel=0.1)
    assert not true.add(ideal[0], mask, rng)[:, :, 0, 0].any()


def test_verdict_names_the_cheaper_way_when_it_is_as_good() -> None:
    def closing(share: float) -> gap.Gap:
        return gap.Gap(share, (share - 0.1, share + 0.1), 1.0, (0.8, 1.2), "")

    shares = {"R": closing(0.5), "N": closing(0.45)}
    assert "not needed" in gap.verdict(shares, (-0.2, -0.1))
    assert "not shown" in gap.verdict(shares, (-0.1, 0.2))
    assert "closes more than" in gap.verdict({"R": closing(0.5), "N": closing(0.2)}, (0.1, 0.2))
