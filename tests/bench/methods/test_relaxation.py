"""Relaxation of an estimated force: closed forms, the solver's own recurrence, lost frames, noise."""

import numpy as np
import pytest

from bench.methods.relaxation import measure_share_left, relax
from synth.fem import driven_contact
from synth.fem.motion import Clock

SWINE = ((0.45, 0.5), (0.365, 50.0))  # Miller & Chinzei, J. Biomech. 35, 2002


def left(time_s: np.ndarray) -> np.ndarray:
    """The part of the stiffness that is left (T,)."""
    return np.asarray(1 - sum(share * (1 - np.exp(-time_s / tau)) for share, tau in SWINE))


def test_a_step_decays_by_the_series_at_uneven_times() -> None:
    time_s = np.sort(np.random.default_rng(0).uniform(0, 8, 40)) - 0.0
    force = np.tile([3.0, 0.0, -4.0], (40, 1))
    relaxed = relax(force, time_s, SWINE)
    np.testing.assert_allclose(relaxed, force * left(time_s - time_s[0])[:, None], rtol=1e-9)
    share = measure_share_left(force, time_s, np.full(40, True), SWINE)
    np.testing.assert_allclose(share, left(time_s - time_s[0]), rtol=1e-9)


def test_a_ramp_is_the_integral_of_steps_however_it_is_sampled() -> None:
    fine_s = np.linspace(0, 4, 40001)
    exact = np.cumsum(left(fine_s)) * (fine_s[1] - fine_s[0])  # of 1 mN/s: the convolution of left with 1
    for count in (5, 50):
        time_s = np.linspace(0, 4, count)
        relaxed = relax(time_s[:, None] * np.ones((1, 3)), time_s, SWINE)
        np.testing.assert_allclose(relaxed[:, 1], np.interp(time_s, fine_s, exact), atol=2e-4)


def test_it_is_the_relaxation_of_a_driven_contact() -> None:
    rng = np.random.default_rng(1)
    force = np.concatenate([np.zeros((1, 3)), np.cumsum(rng.normal(size=(24, 3)), axis=0)])
    clock = Clock(0.04, relaxation=SWINE)
    np.testing.assert_allclose(
        relax(force, 0.04 * np.arange(25), SWINE), driven_contact.relax(force, clock), atol=1e-12
    )


def test_tissue_that_creeps_back_after_contact_bears_hardly_anything() -> None:
    """Pressed for a second, then its motion decays as it would without force."""
    time_s = np.arange(0, 3, 0.05)
    force = np.where(time_s < 1, 10.0, 2.0 * np.exp(-(time_s - 1) / 0.5))[:, None] * np.array([[0, 0, 1.0]])
    share = measure_share_left(force, time_s, np.full(60, True), SWINE)
    assert share[0] == pytest.approx(1)
    assert share[19] == pytest.approx(left(time_s[19:20])[0], rel=0.01)
    assert ((share[21:26] > 0) & (share[21:26] < 0.1)).all()
    assert (share <= 1).all()
    np.testing.assert_array_equal(measure_share_left(force, time_s, np.full(60, True), ()), 1)


def test_lost_frames_neither_count_nor_stay_elastic() -> None:
    time_s = np.arange(0, 3, 0.05)
    force, trusted = np.full((60, 3), 4.0), np.arange(60) % 7 != 3
    force[~trusted] = 1e4
    share = measure_share_left(force, time_s, trusted, SWINE)
    np.testing.assert_allclose(share, left(time_s), rtol=2e-3)
    np.testing.assert_array_equal(measure_share_left(force, time_s, np.full(60, False), SWINE), 1)


def test_a_pinch_whose_forces_cancel_relaxes_by_its_loads_also_under_noise() -> None:
    time_s, rng = np.arange(0, 2.5, 0.05), np.random.default_rng(2)
    pinch = np.tile(np.concatenate([np.full(20, 5.0), np.full(20, -5.0)]), (50, 1))
    noisy = pinch + 0.5 * rng.normal(size=pinch.shape)
    share = measure_share_left(noisy, time_s, np.full(50, True), SWINE)
    np.testing.assert_allclose(share, left(time_s), rtol=0.04)
