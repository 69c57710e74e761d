"""A drift of the sensor's zero is found against the video, and removed; noise and a held load are none."""

import numpy as np
import pytest

from bench.sensor.drift import find_drift, find_rest_spans, remove_drift

TIME = np.arange(80) / 10
LOAD = np.clip(np.minimum(TIME - 2, 5.5 - TIME), 0, 0.5)[:, None] * [30.0, 0.0, 80.0]
RNG = np.random.default_rng(0)
MOTION = np.linalg.norm(LOAD, axis=1) / 200 + 0.004 + 0.001 * RNG.random(80)


def test_drift_after_release_is_found_with_its_size_and_removed() -> None:
    noise = RNG.normal(0, 0.4, LOAD.shape)
    drifting = LOAD + noise + np.outer(TIME / TIME[-1], [1.5, 0.0, 2.0])
    drift = find_drift(TIME, drifting, MOTION)
    assert drift is not None
    assert drift.is_clear
    assert drift.change_mn == pytest.approx(2.5 * np.diff(drift.time_s[[0, -1]])[0] / TIME[-1], abs=0.4)
    steady = remove_drift(TIME, drifting, drift) - LOAD
    assert np.abs(steady[60:].mean(axis=0) - steady[:15].mean(axis=0)).max() < 0.4
    residual_drift = find_drift(TIME, remove_drift(TIME, drifting, drift), MOTION)
    assert residual_drift is not None
    assert not residual_drift.is_clear


@pytest.mark.parametrize("noise_mn", [0.01, 0.4, 3.0])
def test_noise_is_no_drift(noise_mn: float) -> None:
    for seed in range(8):
        noise = np.random.default_rng(seed).normal(0, noise_mn, LOAD.shape)
        drift = find_drift(TIME, LOAD + np.array([14.0, -12.0, 13.0]) + noise, MOTION)
        assert drift is not None
        assert not drift.is_clear


def test_a_load_that_lasts_or_a_video_without_motion_shows_no_zero() -> None:
    assert find_drift(TIME, LOAD, np.maximum.accumulate(MOTION)) is None


def test_short_rests_count_by_the_samples_of_the_sensor() -> None:
    t, fine = np.arange(0, 3, 0.125), np.arange(0, 3.4, 0.01)
    load = np.clip(np.minimum(fine - 0.45, 2.4 - fine) / 0.4, 0, 1)[:, None] * [6.0, 0.0, 4.0]
    noise = np.random.default_rng(0).normal(0, 0.04, load.shape)
    for drift_mn, lag in ((0.0, 0), (1.5, 0), (0.0, 30)):
        record = np.roll(load, -lag, axis=0) + noise + drift_mn * fine[:, None] / 3.4 * [0.6, 0.0, 0.8]
        axes = np.stack([np.interp(t, fine, column) for column in record.T], axis=1)
        motion = np.interp(t, fine, np.linalg.norm(load, axis=1))
        assert find_drift(t, axes, motion) is None, "too few frames"
        drift = find_drift(t, axes, motion, (fine, record))
        assert (drift is not None and drift.is_clear) == bool(drift_mn), "a late clock is no drift"
    assert find_rest_spans(TIME, 0.004 + 0.001 * RNG.random(80)) == []
