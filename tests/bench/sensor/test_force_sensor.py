"""Sensor processing of known signals, and scales from drawn boards."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.recording import recording_scale
from bench.recording.meta import Meta, SensorMeta
from bench.recording.recording_folder import Force
from bench.sensor import force_sensor
from synth.errors import UserError
from synth.video.read_video import Picture


def stack_axes(x: np.ndarray) -> np.ndarray:
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)


def test_tare_and_drift_are_removed() -> None:
    t = np.arange(0, 10, 0.01)
    press = 100 * np.exp(-((t - 5) ** 2))
    raw = Force(t, stack_axes(press + 30 + 2 * t))
    about = SensorMeta(low_pass_hz=None, free_s=((0, 1), (9, 10)))
    sensor = force_sensor.process_force(raw, about, 0.0)
    assert sensor.force_mn[:, 0] == pytest.approx(press, abs=1.1)  # constant beyond the spans' middles


def test_noise_floor_is_the_standard_deviation() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(0, 20, 0.01)
    raw = Force(t, rng.normal(0, 3, (len(t), 3)))
    sensor = force_sensor.process_force(raw, SensorMeta(low_pass_hz=None, free_s=((0, 20),)), 0.0)
    assert sensor.noise_floor_mn == pytest.approx(3 * np.sqrt(3), rel=0.03)


def test_gravity_of_a_rotating_tool_is_removed() -> None:
    t = np.arange(0, 5, 0.01)
    down = np.stack([np.sin(t), np.zeros_like(t), np.cos(t)], axis=1)
    on_tool = -stack_axes(50 * np.exp(-((t - 2) ** 2))) + 20 * force_sensor.STANDARD_GRAVITY * down
    raw = Force(t, -on_tool, down)  # the sign was reversed on reading: force on the tissue
    sensor = force_sensor.process_force(raw, SensorMeta(acts_on="tool", mass_g=20, low_pass_hz=None), 0.0)
    assert sensor.force_mn == pytest.approx(stack_axes(50 * np.exp(-((t - 2) ** 2))), abs=1e-9)
    # In m/s², as from an accelerometer: the removed weight would be ten times too large.
    for gravity in (None, 9.80665 * down):
        with pytest.raises(UserError, match="gx, gy, gz"):
            force_sensor.process_force(Force(t, -on_tool, gravity), SensorMeta(mass_g=20), 0.0)


def test_the_low_pass_has_no_delay() -> None:
    t = np.arange(0, 20, 0.005)
    raw = Force(t, stack_axes(np.sin(2 * np.pi * t) + np.sin(2 * np.pi * 40 * t)))
    force_mn = force_sensor.process_force(raw, SensorMeta(low_pass_hz=8), 0.0).force_mn[:, 0]
    inner = slice(800, -800)
    shifts = np.arange(-40, 100)
    fit = [np.mean((force_mn[inner] - np.sin(2 * np.pi * (t[inner] - s * 0.001))) ** 2) for s in shifts]
    delay_s = 0.001 * shifts[int(np.argmin(fit))]
    assert min(fit) < 1e-3  # the 40 Hz are gone
    assert delay_s == pytest.approx(0, abs=0.001)


@pytest.mark.parametrize(("burst", "filtered"), [(4, True), (40, False)])
def test_stamps_in_bursts_are_filtered_or_reported_as_not(burst: int, filtered: bool) -> None:
    """A link that delivers samples of 500 Hz in packets, all of one packet stamped within 10 us each."""
    n = np.arange(8000)
    t = 0.002 * burst * (n // burst) + 1e-5 * (n % burst)
    raw = Force(t, stack_axes(np.sin(2 * np.pi * 0.002 * n) + np.sin(2 * np.pi * 60 * 0.002 * n)))
    sensor = force_sensor.process_force(raw, SensorMeta(low_pass_hz=8), 0.0)
    error = np.abs(sensor.force_mn[:, 0] - np.sin(2 * np.pi * 0.002 * n))[500:-500].max()
    if filtered:
        assert error < 0.1
        assert np.isfinite(force_sensor.interpolate_force(sensor, np.array([1.0011, 2.0037]))).all()
    assert any("not filtered" in step for step in sensor.steps) is not filtered


def test_a_gap_does_not_change_the_sample_interval_and_frames_in_it_have_no_force() -> None:
    t = np.concatenate([np.arange(0, 5, 0.01), np.arange(2000, 2005, 0.01)])
    sensor = force_sensor.process_force(Force(t, stack_axes(np.sin(2 * np.pi * 30 * t))), SensorMeta(), 0.0)
    assert sensor.steps == ("zero-phase Butterworth low-pass, order 4, 10 Hz",)
    assert np.abs(sensor.force_mn[50:450]).max() < 0.05
    t = np.concatenate([np.arange(0, 1, 0.01), np.arange(2, 3, 0.01)])
    sensor = force_sensor.process_force(Force(t, stack_axes(t)), SensorMeta(low_pass_hz=None), 0.5)
    force_mn = force_sensor.interpolate_force(sensor, np.array([0.2, 0.75, 2.0, 2.75]))
    # Before the sensor began, its clock moved by 0.5 s, and in the gap.
    assert np.isnan(force_mn[[0, 2]]).all()
    assert force_mn[[1, 3], 0] == pytest.approx([0.25, 2.25])


def no_pictures() -> Iterator[Picture]:
    return iter(())


def test_checkerboard_scale(tmp_path: Path) -> None:
    square = 23.4
    y, x = np.mgrid[: 8 * 24 + 60, : 10 * 24 + 60]
    inside = (x >= 30) & (y >= 30) & (x < 30 + 8 * square) & (y < 30 + 6 * square)
    dark = (((x - 30) // square + (y - 30) // square) % 2 == 0) & inside
    cv2.imwrite(str(tmp_path / "board.png"), np.where(dark, 20, 235).astype(np.uint8))

    def find(columns: int, rows: int) -> recording_scale.PixelScale:
        board = {"checkerboard": "board.png", "corners": [columns, rows], "square_mm": 2.0}
        return recording_scale.find_scale(
            Meta.model_validate({"calibration": board}), tmp_path, no_pictures, lambda: np.nan
        )

    scale = find(7, 5)
    assert scale.mm_per_px == pytest.approx(2.0 / square, rel=0.005)
    assert scale.uncertainty < 0.01
    with pytest.raises(UserError, match="no checkerboard"):
        find(4, 4)


def test_scale_bar() -> None:
    about = Meta.model_validate({"calibration": {"bar_px": [[10, 10], [110, 10]], "bar_mm": 5}})
    scale = recording_scale.find_scale(about, Path(), no_pictures, lambda: np.nan)
    assert scale.mm_per_px == pytest.approx(0.05)
    assert scale.uncertainty == pytest.approx(np.sqrt(2) / 100)
