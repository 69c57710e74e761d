"""Relaxation of an estimated force: closed forms, the solver's own recurrence, and the bench on a video."""

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
    np.testing.assert_allclose(measure_share_left(force, time_s, SWINE), left(time_s - time_s[0]), rtol=1e-9)


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


def test_tissue_that_creeps_back_after_contact_bears_nothing() -> None:
    """Pressed for a second, then its motion decays as it would without force: share 0, not less."""
    time_s = np.arange(0, 3, 0.05)
    force = np.where(time_s < 1, 10.0, 2.0 * np.exp(-(time_s - 1) / 0.5))[:, None] * np.array([[0, 0, 1.0]])
    share = measure_share_left(force, time_s, SWINE)
    assert share[0] == pytest.approx(1)
    assert share[19] == pytest.approx(left(time_s[19:20])[0], rel=0.01)
    assert (share[21:26] == 0).all()
    assert ((share >= 0) & (share <= 1)).all()
    np.testing.assert_array_equal(measure_share_left(force, time_s, ()), 1)
