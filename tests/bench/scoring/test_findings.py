"""Findings both ways: clean recordings of several codecs and sensors have none, faulty ones the fault's."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from clean_recordings import TURN, Case, Fit, all_cases, load_mn, make, write_sensor
from fake_recording import texture
from ruamel.yaml import YAML

import bench
from bench.checks import sensor as sensor_checks
from bench.checks.contradiction import check_contradiction
from bench.checks.sensor import SensorMotion
from bench.recording import recording_writer
from synth.flow.recording.picture_faults import VideoFaults

QUICK = Case("h264", (96, 128), "offset"), Case("mp4v", (96, 128), "ati", masks=False)


def list_findings(folder: Path) -> list[tuple[str, str]]:
    result = bench.score(folder, methods={"fit": Fit()}, baselines=False)
    return [(finding.cause, finding.message) for finding in result.findings]


@pytest.mark.parametrize("case", QUICK, ids=lambda case: case.name)
def test_a_clean_recording_has_no_finding(tmp_path: Path, case: Case) -> None:
    assert list_findings(make(tmp_path, case)) == []


@pytest.mark.trial
@pytest.mark.parametrize("case", all_cases(), ids=lambda case: case.name)
def test_none_of_24_clean_recordings_has_a_finding(tmp_path: Path, case: Case) -> None:
    assert list_findings(make(tmp_path, case)) == []


def edit(folder: Path, **sensor: object) -> None:
    meta = YAML(typ="safe").load((folder / "meta.yaml").read_text("utf-8"))
    meta["sensor"] |= sensor
    recording_writer.write_meta(folder, meta)


def test_faults_of_the_sensor_are_found(tmp_path: Path) -> None:
    """Drift, a contact in a span without, and a rest frame under load, each on a recording that is clean."""
    case = Case("png", (96, 128), "offset")
    folder = make(tmp_path, case)
    write_sensor(folder, case, drift_mn_per_s=1.2)
    (drift,) = list_findings(folder)
    assert drift[0] == "sensor"
    edit(folder, drift="remove")
    assert list_findings(folder) == []
    write_sensor(folder, case)
    edit(folder, free_s=[[0.0, 2.0]])
    assert "sensor" in {cause for cause, _ in list_findings(folder)}
    edit(folder, free_s=[[0.0, 0.8]])
    meta = YAML(typ="safe").load((folder / "meta.yaml").read_text("utf-8"))
    recording_writer.write_meta(folder, meta | {"rest_frame": 45})
    assert "rest frame" in {cause for cause, _ in list_findings(folder)}


def test_a_span_with_white_noise_does_not_change_and_one_with_a_step_does() -> None:
    rng = np.random.default_rng(0)
    for count in (20, 120, 1200):
        noise = rng.normal(0, 1.0, (count, 3))
        change, deviation = sensor_checks.find_change(noise)
        assert change < sensor_checks._SIGMAS * deviation * 1.6
        step = noise + 8.0 * (np.arange(count) > 0.6 * count)[:, None]
        change, deviation = sensor_checks.find_change(step)
        assert change == pytest.approx(8 * np.sqrt(3), rel=0.2)
        assert change > sensor_checks._SIGMAS * deviation


def test_spikes_are_found_and_noise_steps_and_slow_sensors_have_none() -> None:
    t, rng = np.arange(0, 5.2, 0.01), np.random.default_rng(3)
    for load in (load_mn(t), 0 * load_mn(t)):  # a step is no spike
        clean = load + rng.normal(0, 0.4, (len(t), 3)) + 20.0 * (t > 3.2)[:, None]
        assert not len(sensor_checks.find_spikes(t, clean)[0])
        spiky = clean.copy()
        spiky[[100, 101, 340]] += [60.0, -40.0, 0.0]
        times_s, height_mn = sensor_checks.find_spikes(t, spiky)
        np.testing.assert_allclose(times_s, t[[100, 101, 340]])
        assert height_mn == pytest.approx(72, rel=0.05)
        assert not len(sensor_checks.find_spikes(10 * t, spiky)[0]), "10 Hz: a touch may be as short"


def _compare(video_s: np.ndarray, more_mn: np.ndarray | float = 0.0) -> list[tuple[str, str]]:
    """Findings where the frames (T,) show what the sensor measures at `video_s` (T,), and `more_mn` (T,)."""
    t = np.arange(0, 5.2, 0.1)
    size = np.linalg.norm(load_mn(video_s), axis=1) ** 0.8 * 2 + more_mn  # tissue stiffens
    leading = size[:, None] * [0.3, 0.1, 0.95]
    bounds = size[:, None] * [0.6, 1.6] + [-3.0, 3.0]
    sensor = SensorMotion(t, load_mn(t), size, (leading,), 0, leading, bounds, np.zeros(3))
    return [(finding.cause, finding.message) for finding in check_contradiction(sensor)]


def test_clocks_are_judged_by_the_begin_and_end_of_contacts() -> None:
    t = np.arange(0, 5.2, 0.1)
    assert _compare(t) == []
    assert _compare(t - 0.05) == [], "creep"
    for late_s in (-0.35, 0.3, 0.5):
        ((cause, message),) = _compare(t - late_s)
        assert cause == "clocks"
        assert f"{late_s:+.1f}" in message or f"{late_s:+.2f}" in message
    assert {cause for cause, _ in _compare(t / 1.2)} == {"clocks"}
    assert {cause for cause, _ in _compare(np.where(t < 1.8, t, t + 0.4))} == {"clocks"}, "pictures missing"


def test_a_force_that_the_sensor_does_not_measure_is_found() -> None:
    t = np.arange(0, 5.2, 0.1)
    beside = 40.0 * np.exp(-(((t - 0.6) / 0.15) ** 2))
    ((cause, message),) = _compare(t, beside)
    assert cause == "sensor"
    assert "contact" in message
    assert _compare(t, 0.1 * beside) == []


def test_axes_of_a_mirrored_picture_are_named() -> None:
    t = np.arange(0, 5.2, 0.1)
    force = load_mn(t) * [1.0, 1.0, 0.3]
    leading, size = force * [-1, 1, 1], np.linalg.norm(force, axis=1)
    bounds = size[:, None] * [0.5, 1.5] + [-3.0, 3.0]
    sensor = SensorMotion(t, force, size, (leading,), 2, leading, bounds, np.zeros(3))
    (finding,) = check_contradiction(sensor)
    assert finding.cause == "sensor"
    assert "mirrored" in finding.message


def _find_turn(estimate: np.ndarray, axes: np.ndarray) -> set[str]:
    """Causes found where the video's force is the true one turned by `estimate` (3, 3) and the sensor's
    by `axes` (3, 3)."""
    t = np.arange(0, 5.2, 0.1)
    force = load_mn(t)
    leading = force @ estimate.T
    bounds = np.linalg.norm(leading, axis=1)[:, None] * [0.5, 1.5] + [-3.0, 3.0]
    motion = np.linalg.norm(force, axis=1)
    sensor = SensorMotion(t, force @ axes.T, motion, (leading,), 3, leading, bounds, np.zeros(3))
    return {finding.cause for finding in check_contradiction(sensor)}


def test_an_estimate_off_by_40_degrees_is_no_exchange_of_axes_but_exchanged_axes_are() -> None:
    for degrees in (-40, -25, 25, 40):
        for axis in np.eye(3):
            turn = cv2.Rodrigues(np.radians(degrees) * axis)[0]
            assert _find_turn(turn, np.eye(3)) == set()
    assert _find_turn(np.eye(3), -np.eye(3)) == {"sensor"}
    assert _find_turn(np.eye(3), np.eye(3)[[1, 2, 0]]) == {"sensor"}
    assert np.linalg.det(TURN) == pytest.approx(1)


@pytest.mark.parametrize("key_interval", [12, 250])
def test_a_key_frame_is_no_cut_and_a_bump_is(key_interval: int) -> None:
    """Pictures without change, whose detail is coded anew in key frames; the camera is bumped in the 31st."""
    rest, rng = texture(96, 136).astype(np.float32), np.random.default_rng(0)
    for is_bumped in (False, True):
        pictures, detail = [], np.zeros((96, 128, 3))
        for k in range(60):
            if k % key_interval == 0:
                detail = rng.normal(0, 4, (96, 128, 3))
            view = rest[:, 2:130] if is_bumped and k > 30 else rest[:, :128]
            pictures.append(np.clip(view + detail, 0, 255).astype(np.uint8))
        faults = VideoFaults(pictures[0], pictures[0], np.ones((96, 128), bool))
        for k, picture in enumerate(pictures[1:], 1):
            faults.add_decoded(k, k / 25, picture)
        assert faults._find_leaps() == ([30] if is_bumped else [])


@pytest.mark.parametrize(("may_pulsate", "noise_mn"), [(False, 0.0), (True, 0.0), (True, 0.1)])
def test_a_stuck_component_is_found_and_a_force_held_on_living_tissue_is_none(
    may_pulsate: bool, noise_mn: float
) -> None:
    t = np.arange(0, 4, 0.1)
    steady_force = np.clip(t - 1, 0, 1)[:, None] * np.array([3.0, -1.0, 5.0])  # without noise, as of a render
    moved = steady_force[:, 0] + 1.5 * np.sin(7 * t)
    saturated = np.column_stack(
        [steady_force[:, :2] + 0.1 * np.sin(9 * t)[:, None], np.minimum(steady_force[:, 2], 4.0)]
    )
    for axes, is_found in ((steady_force, noise_mn > 0 or not may_pulsate), (saturated, True)):
        sensor = SensorMotion(t, axes, moved, may_pulsate=may_pulsate, noise_mn=noise_mn)
        assert bool(sensor_checks.check_constant(sensor)) is is_found
