"""Figures of skill against closed forms."""

import numpy as np
import pytest

from bench.scoring.skill import skill


def test_figures_of_a_raised_sine() -> None:
    """F = 5 (1 - cos wt) mN over whole periods: mean 5, |dF/dt| 20 a period, variation 1 / sqrt 2."""
    time = np.linspace(0, 4, 4001)
    force = 5 * (1 - np.cos(2 * np.pi * time))
    figures = skill(time, force, np.ones(len(time), bool), 5.0)
    assert figures["change_mn_per_s"] == pytest.approx(20, rel=1e-4)
    assert figures["variation"] == pytest.approx(2**-0.5, rel=1e-4)
    assert figures["impulse_mns"] == pytest.approx(20, rel=1e-5)
    assert figures["idle_share"] == pytest.approx(0.5, abs=1e-3)


def test_uneven_times_count_by_their_length_and_gaps_are_not_bridged() -> None:
    time = np.array([0.0, 0.1, 0.5, 1.0, 1.2, 2.0])
    force = np.array([2.0, 2.0, 2.0, np.nan, 8.0, 8.0])
    used = np.ones(6, bool)
    figures = skill(time, force, used, 4.0)
    assert figures["change_mn_per_s"] == 0  # not 6 mN over the gap
    assert figures["impulse_mns"] == pytest.approx(2 * 0.5 + 8 * 0.8)
    assert figures["idle_share"] == pytest.approx(0.5 / 1.3)
    used[:3] = False
    assert skill(time, force, used, 4.0)["variation"] == 0
    nothing = skill(time, force, ~used & (np.arange(6) == 1), 4.0)
    assert np.isnan(list(nothing.values())).all()


def test_an_untouched_tissue_has_no_variation() -> None:
    figures = skill(np.arange(5.0), np.zeros(5), np.ones(5, bool), 1.0)
    assert np.isnan(figures["variation"])
    assert figures["idle_share"] == 1
    assert figures["impulse_mns"] == 0
