"""Findings on recordings: the same in `bench check` and `bench score`, and no scores with errors."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from fake_recording import Maker, score_recording, texture
from typer.testing import CliRunner

from bench.checks.check_recording import check_recording
from bench.checks.files import check_tissue
from bench.checks.judgement import SENSOR_CHECKS
from bench.checks.sensor import SensorMotion, find_other_rest
from bench.checks.times import check_margin
from bench.cli import app
from bench.recording.recording_folder import open_recording
from bench.scoring.headline import headline
from bench.scoring.result import as_json
from bench.tracking.tracking import TrackedRecording
from synth.flow.recording.finding import Finding, Severity

# E in Pa and in MPa, the scale in metres, pixels that are millimetres wide.
UNITS = ("young_kpa", 1500.0), ("young_kpa", 0.0015), ("scale_mm_per_px", 2.5e-4), ("scale_mm_per_px", 3.0)


@pytest.mark.parametrize(("key", "value"), UNITS)
def test_wrong_units_are_found_by_check_and_score(make: Maker, key: str, value: float) -> None:
    folder, cause = make(frames=6, meta={key: value}), "stiffness" if key == "young_kpa" else "scale"
    result = score_recording(folder, backend="dis")
    errors = [finding for finding in result.findings if finding.severity == "error"]
    assert [finding.cause for finding in errors] == [cause]
    assert errors == [finding for finding in check_recording(folder) if finding.severity == "error"]
    assert np.isnan(result.methods["bump"].size_mn).all()
    assert headline(result).tiles == ()
    assert next(iter(as_json(result)["findings"]))["cause"] == cause


@pytest.mark.parametrize(("frames", "young", "code"), [(8, 1.0, 0), (8, 1500.0, 2), (2, 1.0, 2)])
def test_a_refused_score_writes_its_files_and_exits_with_code_2(
    make: Maker, frames: int, young: float, code: int
) -> None:
    folder = make(frames=frames, meta={"young_kpa": young})
    result = CliRunner().invoke(app, ["score", str(folder), "-o", str(folder / "score"), "--flow", "dis"])
    assert result.exit_code == code, result.output
    assert ("MAE [mN]" in result.stdout) == (code == 0)  # the table
    assert {"score.json", "report.html"} == {file.name for file in (folder / "score").iterdir()}
    words = [str(folder / "frames"), "--scale", "0.2", "--young", str(young), "-o", str(folder / "p")]
    assert CliRunner().invoke(app, ["estimate", *words]).exit_code == (0 if young < 9 else 2)


@pytest.mark.parametrize(("rest", "free"), [(6, [[0.0, 0.05]]), (0, [[0.2, 0.8]])])
def test_load_at_the_rest_frame_or_in_a_free_span_is_found_by_check_and_score(
    make: Maker, rest: int, free: list[list[float]]
) -> None:
    sensor = {"axes": "camera", "low_pass_hz": None, "free_s": free}
    folder = make(frames=12, meta={"rest_frame": rest, "sensor": sensor})
    warnings = [
        finding
        for finding in score_recording(folder, backend="dis").findings
        if finding.severity == "warning"
    ]
    expected = [finding for finding in warnings if finding.cause == ("rest frame" if rest else "sensor")]
    assert expected
    assert set(expected) <= set(check_recording(folder))


TIME = np.arange(120) / 10
PRESS = np.sin(TIME * 1.3)[:, None] ** 2 * [1.0, -2.0, 4.0] + np.sin(TIME)[:, None] ** 4 * [3.0, 1.0, 0.0]


def interpolate_press(time_s: np.ndarray) -> np.ndarray:
    """`PRESS` at other times (T,): (T, 3)."""
    return np.stack([np.interp(time_s, TIME, axis) for axis in PRESS.T], axis=1)


SENSORS = {
    "mN for N": (1000 * PRESS, "error", "sensor"),
    "E too large by 5": (PRESS / 5, "error", "force"),
    "rest frame under load": (PRESS - [1.0, -2.0, 4.0], "error", "rest frame"),
    "on the tool": (-PRESS, "warning", "sensor"),
    "axes permuted": (PRESS[:, [1, 2, 0]], "warning", "sensor"),
    "constant": (0 * PRESS + 2.0, "error", "sensor"),
    "saturated": (PRESS.clip(-9, 2.0), "warning", "sensor"),
    "0.6 s late": (np.roll(PRESS, 6, axis=0), "error", "clocks"),
    "a clock 8% slow": (interpolate_press(0.92 * TIME), "error", "clocks"),
    "stamped 30 for 25": (interpolate_press(TIME / 1.2), "error", "clocks"),
    "stamped 30 for 25, and late": (interpolate_press((TIME - 0.5) / 1.2), "error", "clocks"),
    "stamped 25 for 30": (interpolate_press(1.2 * TIME), "error", "clocks"),
    "stamped 24 for 30": (interpolate_press(0.8 * TIME), "error", "clocks"),
    "backwards": (PRESS[::-1], "error", "clocks"),
    "0.5 s of the video missing": (np.concatenate([PRESS[:55], PRESS[50:115]]), "warning", "clocks"),
}


def find_contradictions(axes: np.ndarray, methods: list[np.ndarray]) -> set[tuple[str, str]]:
    """Severity and cause of findings on a sensor (T, 3) next to the motion of `PRESS` and forces (T, 3), the
    first with an interval of 40%."""
    bounds = np.linalg.norm(methods[0], axis=1)[:, None] * [0.6, 1.4]
    motion, leading = np.linalg.norm(PRESS, axis=1) ** 0.9, methods[0]
    sensor = SensorMotion(TIME, axes, motion, tuple(methods), 3, leading, bounds, axes[0])
    return {(finding.severity, finding.cause) for check in SENSOR_CHECKS for finding in check(sensor)}


METHODS = [0.8 * PRESS, 1.2 * PRESS]


@pytest.mark.parametrize("case", SENSORS)
def test_a_sensor_that_contradicts_the_video_is_found(case: str) -> None:
    axes, severity, cause = SENSORS[case]
    assert (severity, cause) in find_contradictions(axes, METHODS)


def test_a_sensor_that_agrees_or_is_doubtful_is_no_error() -> None:
    assert find_contradictions(PRESS, METHODS) == set()
    assert find_contradictions(PRESS, [60 * PRESS]) == {("warning", "force")}, (
        "one method may be wrong itself"
    )
    late = np.roll(PRESS, 6, axis=0)
    assert find_contradictions(late, [0.8 * PRESS]) == {("error", "clocks")}, (
        "the tissue's mean motion shows it too"
    )
    spiked = PRESS + 400 * (np.arange(len(PRESS)) == 3)[:, None]
    noise = np.random.default_rng(1).normal(0, 0.3, PRESS.shape)
    for axes in (spiked, noise):
        assert "error" not in {severity for severity, _ in find_contradictions(axes, METHODS)}


def test_two_contacts_suffice_for_a_rate_and_an_offset() -> None:
    load = np.exp(-(((TIME - 2) / 0.4) ** 2)) + 0.8 * np.exp(-(((TIME - 7) / 0.7) ** 2))
    force = load[:, None] * [1.0, -2.0, 4.0]
    # The video, taken at 25 a second and stamped as 30, is 0.5 s late.
    axes = np.stack([np.interp((TIME - 0.5) / 0.8333, TIME, axis) for axis in force.T], axis=1)
    methods = 0.9 * axes, 1.1 * axes
    bounds = np.linalg.norm(methods[0], axis=1)[:, None] * [0.6, 1.4]
    motion = np.linalg.norm(axes, axis=1) ** 0.9
    sensor = SensorMotion(TIME, force, motion, methods, 3, methods[0], bounds, force[0])
    findings = [finding for check in SENSOR_CHECKS for finding in check(sensor) if finding.cause == "clocks"]
    assert any("0.8333" in finding.message for finding in findings)


def test_a_video_that_starts_under_load_rests_elsewhere() -> None:
    load = np.interp(np.arange(70), [15, 24, 45, 54], [0, 1, 1, 0])
    # Whole, released, and held at the start or at the end, of which the video shows the same.
    for start, stop, is_certain in ((0, 70, None), (20, 70, True), (26, 70, False), (0, 45, False)):
        other_rest = find_other_rest(TIME[: stop - start], np.abs(load - load[start])[start:stop])
        assert (other_rest and other_rest[1]) == is_certain, (start, stop)


BLACK = np.zeros((96, 128, 3), np.uint8)


@pytest.mark.parametrize(
    ("span_s", "is_named"), [((0.0, 3.5), False), ((0.0, 1.0), True), ((3.0, 4.5), True)]
)
def test_a_sensor_that_starts_with_the_video_has_enough_samples_to_align_their_clocks(
    make: Maker, span_s: tuple[float, float], is_named: bool
) -> None:
    sync = {"method": "correlate", "calibration_s": list(span_s), "search_s": 0.5}
    recording = open_recording(make(frames=41, meta={"sync": sync}))
    assert bool(check_margin(recording, TrackedRecording())) == is_named


@pytest.mark.parametrize("picture", [BLACK + 3, BLACK + 128, texture(16, 16), texture(96, 128)])
def test_recordings_without_texture_or_motion_have_no_scores(make: Maker, picture: np.ndarray) -> None:
    folder = make(frames=4)
    for k in range(4):
        cv2.imwrite(str(folder / "frames" / f"{k:04d}.png"), picture)
    result = score_recording(folder, backend="dis")
    assert result.lost.all()
    assert headline(result).refused


def test_a_single_black_frame_is_lost(make: Maker) -> None:
    folder = make(frames=8)
    cv2.imwrite(str(folder / "frames" / "0004.png"), BLACK)
    result = score_recording(folder, backend="dis")
    assert np.flatnonzero(result.lost).tolist() == [4]


@pytest.mark.parametrize(("severity", "count"), [("error", 1), ("warning", 1), ("missing", 0)])
def test_the_cost_of_a_wrong_tissue_is_said_only_where_the_one_found_is_in_doubt(
    make: Maker, severity: Severity, count: int
) -> None:
    recording = open_recording(make(frames=2))
    tracked = TrackedRecording(findings=[Finding(severity, "tissue", "found")])
    assert len(check_tissue(replace(recording, tissue=None), tracked)) == count
