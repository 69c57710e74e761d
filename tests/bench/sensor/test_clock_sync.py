"""Offsets between clocks: found within a frame, or refused if the recording doesn't determine them."""

import numpy as np
import pytest

from bench.sensor import clock_sync


def presses(t: np.ndarray, seed: int) -> np.ndarray:
    """Irregular presses, as by hand [mN]."""
    rng = np.random.default_rng(seed)
    out = np.zeros_like(t)
    for centre in np.cumsum(rng.uniform(0.6, 1.8, 20)):
        out += rng.uniform(40, 150) * np.exp(-((t - centre) ** 2) / (2 * rng.uniform(0.08, 0.2) ** 2))
    return out


def recording(
    lag_s: float, seed: int = 0, noise: float = 0.15, fps: float = 25.0, span_s: float = 8.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Frames, speed, sensor times and force; the sensor's clock is `lag_s` slow."""
    rng = np.random.default_rng([seed, 1])
    frames = 1 + np.cumsum(rng.uniform(0.8, 1.2, round(span_s * fps)) / fps)  # variable frame rate
    speed = np.abs(np.diff(presses(frames, seed), prepend=0)) / np.diff(frames, prepend=frames[0] - 1 / fps)
    speed[0] = 0
    speed = 0.01 * (speed + noise * speed.max() * np.abs(rng.normal(size=len(speed))))
    t = np.arange(0, 12, 0.002)
    force = presses(t, seed) + rng.normal(0, 0.3, len(t))
    return frames, speed, t - lag_s, np.stack([force, 0 * t, 0 * t], axis=1)


@pytest.mark.parametrize("lag_s", [-0.5, -0.313, 0.0, 0.04, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_known_lags_within_one_frame(lag_s: float, seed: int) -> None:
    offset = clock_sync.find_offset(*recording(lag_s, seed), search_s=0.7)
    assert offset.refused == ""
    assert offset.offset_s == pytest.approx(lag_s, abs=1 / 25)
    assert abs(offset.offset_s - lag_s) < 5 * max(offset.deviation_s, 0.004)


def test_periodic_presses_are_ambiguous() -> None:
    frames = np.arange(0, 8, 0.04)
    t = np.arange(-1, 9, 0.002)
    rng = np.random.default_rng(0)
    force = 100 * np.clip(np.sin(2 * np.pi * 2 * t), 0, None)
    speed = np.abs(np.gradient(100 * np.clip(np.sin(2 * np.pi * 2 * frames), 0, None), 0.04))
    speed = speed + rng.normal(0, 40, len(speed))
    assert clock_sync.find_offset(frames, speed, t, np.stack([force] * 3, 1), 0.6).refused


def test_intervals_that_were_not_tracked_are_left_out() -> None:
    frames, speed, t, force = recording(0.2)
    lost = np.arange(20, 60)
    speed[lost] = np.nan
    offset = clock_sync.find_offset(frames, speed, t, force, 0.7)
    assert offset.refused == ""
    assert offset.offset_s == pytest.approx(0.2, abs=1 / 25)
    speed[15:] = np.nan
    assert clock_sync.find_offset(frames, speed, t, force, 0.7).refused


def test_undetermined_offsets_are_refused() -> None:
    frames, speed, t, force = recording(0.0)
    noise = np.abs(np.random.default_rng(5).normal(size=len(frames)))
    short = frames[:10], speed[:10]
    for frame_s, motion in (short, (frames, noise), (frames, 0 * speed), (frames + 100, speed)):
        assert clock_sync.find_offset(frame_s, motion, t, force, 0.5).refused
    assert clock_sync.find_offset(*recording(0.5), search_s=0.3).refused, "beyond the search"
