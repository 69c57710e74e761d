"""Scoring from folder to score.json and report.html, with known displacement and force, on any clock."""

import json
from pathlib import Path

import numpy as np
import pytest
from fake_recording import Maker, force_curve, score_recording
from scipy.spatial.transform import Rotation

from bench.checks.check_recording import check_recording
from bench.recording import recording_writer
from bench.scoring import force_metrics
from bench.scoring.score import write_result


@pytest.mark.parametrize("footage", ["png", "mp4"])
def test_force_is_recovered_from_the_video(make: Maker, footage: str) -> None:
    scores = score_recording(make(footage=footage)).methods["bump"].scores
    assert scores["r"] > 0.998
    assert scores["mae_mn"] < 8  # of 120: TV-L1 flattens peaks of a few pixels
    assert abs(scores["lag_s"]) <= 0.025
    assert scores["contact_f1"] == 1
    assert scores["false_positive_rate"] == 0


def test_fast_footage_is_thinned_and_large_pictures_shrunk(make: Maker) -> None:
    folder = make(frames=13, fps=40.0, size=(96, 640))
    result = score_recording(folder, shrink=0, rate_hz=10.0)
    assert result.tracked.frame == [0, 4, 8, 12]
    assert result.tracked.tissue.shape == (48, 320)


def test_sensor_gap_is_not_scored(make: Maker) -> None:
    folder = make(frames=20)
    rows = (folder / "force.csv").read_text().splitlines()
    (folder / "force.csv").write_text("\n".join(rows[:51] + rows[120:]) + "\n")  # 0.5 s to 1.2 s gone
    result = score_recording(folder)
    missing = ~np.isfinite(result.sensor_mn)
    assert missing.tolist() == [0.49 < t < 1.185 for t in result.time_s]


def test_json_has_no_nan_and_the_page_stands_alone_and_escapes(make: Maker, tmp_path: Path) -> None:
    result = score_recording(make(frames=12, meta={"specimen": "<script>alert(1)</script>"}))
    write_result(result, tmp_path, "</title><script>alert(2)</script>")
    tree = json.loads((tmp_path / "score.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert tree["scores"]["n"] == 12
    assert len(tree["curve"]["predicted_mn"]["bump"]) == 12
    page = (tmp_path / "report.html").read_text()
    assert page.count("<svg") == 3
    for reference in ('src="http', "src='http", 'href="http', "@import", "<script>alert"):
        assert reference not in page


def test_without_stiffness_only_scores_independent_of_a_factor_are_reported(make: Maker) -> None:
    folder = make(frames=30, meta={"young_kpa": "unknown", "press_s": [0.2, 1.2]})
    result = score_recording(folder)
    scores, calibrated = result.methods["bump"].scores, result.methods["bump"].calibrated
    assert scores["r"] > 0.99
    assert all(np.isnan(scores[key]) for key in ("mae_mn", "rmse_mn", "ccc", "r2", "gain", "contact_f1"))
    assert set(result.methods["bump"].intervals) == {"r"}
    assert calibrated["mae_mn"] < 10  # after the press's gain forces are in newtons


def test_a_contact_ends_at_samples_that_are_not_scored() -> None:
    time = np.arange(100) / 10.0
    force = np.full(100, 50.0)
    force[:5] = 0
    used = np.ones(100, bool)
    used[40:60] = False
    _, events = force_metrics.compute_all(time, force, force, 0.0, used)
    assert [(event["from_s"], event["to_s"]) for event in events] == [(0.5, 3.9), (6.0, 9.9)]


EPOCH = 1.7e9


def stamp_since_1970(folder: Path, frames: int, tables: str = "both") -> None:
    time = np.arange(frames) / 10
    t = np.arange(0, time[-1] + 1e-9, 0.01)
    recording_writer.write_frames(folder, time + EPOCH * (tables != "force"))
    newtons = np.outer(force_curve(t) / 1000, [1.0, 0.0, 0.0])
    recording_writer.write_force(folder, t + EPOCH * (tables != "frames"), newtons)


def test_times_since_1970_are_counted_from_the_start(make: Maker) -> None:
    spans = {"press_s": [EPOCH + 0.2, EPOCH + 1.0], "sensor": {"free_s": [[EPOCH, EPOCH + 0.15]]}}
    stamped_folder = make("stamped", frames=20, meta=spans)
    stamp_since_1970(stamped_folder, 20)
    plain_folder = make("plain", frames=20, meta={"press_s": [0.2, 1.0], "sensor": {"free_s": [[0.0, 0.15]]}})
    stamped_result, plain_result = score_recording(stamped_folder), score_recording(plain_folder)
    assert stamped_result.time_s == pytest.approx(plain_result.time_s, abs=1e-5)
    assert stamped_result.scored.tolist() == plain_result.scored.tolist()
    errors = [result.methods["bump"].scores["mae_mn"] for result in (stamped_result, plain_result)]
    assert errors[0] == pytest.approx(errors[1], abs=1e-3)
    severities = {f.cause: f.severity for f in check_recording(stamped_folder)}
    assert (severities["clocks"], severities["spans"]) == ("ok", "ok")


@pytest.mark.parametrize("tables", ["frames", "force"])
def test_a_single_clock_since_1970_is_not_scored(make: Maker, tables: str) -> None:
    folder = make(frames=6)
    stamp_since_1970(folder, 6, tables)
    assert score_recording(folder).methods["bump"].scores == {}


def test_a_rotated_sensor_is_converted_to_the_cameras_axes(make: Maker) -> None:
    turn = Rotation.from_euler("xyz", [40, -25, 70], degrees=True).as_matrix()
    about = {"sensor": {"axes": "sensor", "to_camera": turn.tolist(), "low_pass_hz": None}}
    folder = make(frames=12, meta=about)
    t = np.arange(0, 1.11, 0.01)
    in_camera = np.outer(force_curve(t) / 1000, [1.0, 0.0, 0.0])
    recording_writer.write_force(folder, t, in_camera @ turn)  # R^T f, as rows
    result = score_recording(folder)
    assert result.sensor_axes_mn[:, 0] == pytest.approx(force_curve(np.arange(12) / 10), abs=0.5)
    assert np.abs(result.sensor_axes_mn[:, 1:]).max() < 1e-3
    assert set(result.methods["bump"].components) == {"x", "y", "z"}


def test_unknown_scale_gives_relative_forces(make: Maker) -> None:
    unscaled = score_recording(make("one", frames=20, meta={"scale_mm_per_px": "unknown", "young_kpa": 1.0}))
    scaled = score_recording(make("two", frames=20, meta={"scale_mm_per_px": 32 / 128, "young_kpa": 1.0}))
    assert unscaled.scale.mm_per_px == scaled.scale.mm_per_px
    assert scaled.absolute
    assert not unscaled.absolute
    scores, newtons = unscaled.methods["bump"].scores, scaled.methods["bump"].scores
    assert scores["r"] == pytest.approx(newtons["r"])
    assert np.isfinite(newtons["mae_mn"])
    assert not np.isfinite(scores.get("mae_mn", np.nan))
