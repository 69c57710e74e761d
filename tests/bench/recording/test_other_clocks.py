"""Stamps since 1970, bursts, sensors that lie across, and phantoms that are pushed hard."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_recording import Bump, Maker, force_curve, texture
from scipy.spatial.transform import Rotation

from bench.recording import check, pixel_scale, writer
from bench.recording.folder import open_recording
from bench.scoring import evaluate_recording
from bench.scoring.evaluate_recording import Result, Settings
from synth.errors import UserError

EPOCH = 1.7e9


def since_1970(folder: Path, frames: int, stamped: str = "both") -> None:
    time = np.arange(frames) / 10
    t = np.arange(0, time[-1] + 1e-9, 0.01)
    writer.write_frames(folder, time + EPOCH * (stamped != "force"))
    newtons = np.outer(force_curve(t) / 1000, [1.0, 0.0, 0.0])
    writer.write_force(folder, t + EPOCH * (stamped != "frames"), newtons)


def run(folder: Path) -> Result:
    recording = open_recording(folder)
    return evaluate_recording.evaluate_recording(
        recording, {"bump": Bump()}, "bump", pixel_scale.find_scale(recording.meta, folder),
        Settings("dis", shrink=1, rate_hz=None), {},
    )  # fmt: skip


def test_times_since_1970_are_brought_to_the_start_for_check_and_score(make: Maker) -> None:
    spans = {"press_s": [EPOCH + 0.2, EPOCH + 1.0], "sensor": {"free_s": [[EPOCH, EPOCH + 0.15]]}}
    stamped = make("stamped", frames=20, meta=spans)
    since_1970(stamped, 20)
    plain = make("plain", frames=20, meta={"press_s": [0.2, 1.0], "sensor": {"free_s": [[0.0, 0.15]]}})
    one, other = run(stamped), run(plain)
    assert one.time_s == pytest.approx(other.time_s, abs=1e-5)
    assert one.scored.tolist() == other.scored.tolist()
    assert one.methods["bump"].scores["mae_mn"] == pytest.approx(
        other.methods["bump"].scores["mae_mn"], abs=1e-3
    )
    assert any("since 1970" in note for note in one.notes)
    said = {f.what: f.state for f in check.check_recording(stamped)}
    assert said["clocks"] == "ok"
    assert said["press"] == "ok"


@pytest.mark.parametrize("stamped", ["frames", "force"])
def test_one_clock_since_1970_is_said_and_not_guessed_at(make: Maker, stamped: str) -> None:
    folder = make(frames=6)
    since_1970(folder, 6, stamped)
    result = run(folder)
    assert any("nobody can tell" in note for note in result.notes)
    assert result.methods["bump"].scores == {}


def test_frame_rate_is_from_the_first_frame_to_the_last(make: Maker) -> None:
    folder = make(frames=21)
    # Two frames at once, then a long wait: 10 a second, whatever the median step says.
    writer.write_frames(folder, np.arange(21) // 2 * 0.2 + np.arange(21) % 2 * 0.01)
    said = next(f.said for f in check.check_recording(folder) if f.what == "times" and f.state == "ok")
    assert "at 10 frames a second" in said


def test_a_sensor_that_lies_across_is_turned_into_the_cameras_axes(make: Maker) -> None:
    turn = Rotation.from_euler("xyz", [40, -25, 70], degrees=True).as_matrix()
    about = {"sensor": {"axes": "sensor", "to_camera": turn.tolist(), "low_pass_hz": None}}
    folder = make(frames=12, meta=about)
    t = np.arange(0, 1.11, 0.01)
    in_camera = np.outer(force_curve(t) / 1000, [1.0, 0.0, 0.0])
    writer.write_force(folder, t, in_camera @ turn)  # R^T f, as rows
    result = run(folder)
    assert result.sensor_axes_mn is not None
    assert result.sensor_axes_mn[:, 0] == pytest.approx(force_curve(np.arange(12) / 10), abs=0.5)
    assert np.abs(result.sensor_axes_mn[:, 1:]).max() < 1e-3
    assert set(result.methods["bump"].components) == {"x", "y", "z"}


@pytest.mark.slow
def test_the_rotation_is_found_on_a_span_and_that_is_not_scored(make: Maker) -> None:
    turn = Rotation.from_euler("xyz", [40, -25, 70], degrees=True).as_matrix()
    folder = make(frames=60, meta={"sensor": {"turn_s": [0, 4.05], "low_pass_hz": None}})
    time = np.arange(60) / 10
    # Pulled to and fro in the picture, and pressed: the bump gives way to the pull alone.
    way = np.stack([np.sin(2.1 * time), np.sin(3.3 * time + 1), 0.6 * np.sin(1.3 * time)], axis=1)
    rest, (y, x) = texture(96, 128), np.mgrid[:96, :128].astype(np.float32)
    bump = np.exp(-((x - 64) ** 2 + (y - 48) ** 2) / (2 * 18**2))
    for k, (right, down, _) in enumerate(3 * (way - way[0])):
        moved = cv2.remap(rest, x - np.float32(right) * bump, y - np.float32(down) * bump, cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / "frames" / f"{k:04d}.png"), moved[..., ::-1])
    in_camera = 0.05 * (way - way[0])
    writer.write_force(folder, time, in_camera @ turn)  # R^T f, as rows
    assert any("sensor.turn_s holds 4.05 s" in f.said for f in check.check_recording(folder))
    result = run(folder)
    assert result.turn is not None
    off = np.degrees(Rotation.from_matrix(result.turn.rows @ turn.T).magnitude())
    assert off < min(3 * result.turn.deviation_deg, 6), result.turn
    assert result.sensor_axes_mn == pytest.approx(1000 * in_camera, abs=12)
    assert set(result.methods["bump"].components) == {"x", "y", "z"}
    assert not result.scored[time <= 4.05].any()
    assert result.scored[time > 4.05].all()
    assert any(f"± {result.turn.deviation_deg:.1f}°" in note for note in result.notes)


def test_what_is_no_rotation_is_refused(make: Maker) -> None:
    mirrored = make("a", frames=2, meta={"sensor": {"to_camera": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}})
    with pytest.raises(UserError, match="must be a rotation"):
        open_recording(mirrored)
    both = make("b", frames=2, meta={"sensor": {"axes": "camera", "turn_s": [0, 1]}})
    with pytest.raises(UserError, match="give one of them"):
        open_recording(both)


def test_a_phantom_may_be_pushed_with_more_than_50_newtons(make: Maker) -> None:
    folder = make(frames=4)
    t = np.arange(0, 0.31, 0.01)
    writer.write_force(folder, t, np.outer(80 * t / t[-1], [0.0, 0.0, 1.0]))
    with pytest.raises(UserError, match="--phantom"):
        open_recording(folder)
    assert open_recording(folder, phantom=True).force is not None
    assert not any("newtons" in f.said for f in check.check_recording(folder, phantom=True))
    said = make("said", frames=4, meta={"tissue": "phantom"})
    writer.write_force(said, t, np.outer(80 * t / t[-1], [0.0, 0.0, 1.0]))
    assert open_recording(said).force is not None


def test_unknown_scale_gives_answers_up_to_a_factor_and_says_so(make: Maker) -> None:
    one = run(make("one", frames=20, meta={"scale_mm_per_px": "unknown", "young_kpa": 1.0}))
    known = run(make("two", frames=20, meta={"scale_mm_per_px": 32 / 128, "young_kpa": 1.0}))
    assert one.scale.mm_per_px == known.scale.mm_per_px
    assert known.absolute
    assert not one.absolute
    assert any("scale unknown" in note for note in one.notes)
    scores, newtons = one.methods["bump"].scores, known.methods["bump"].scores
    assert scores["r"] == pytest.approx(newtons["r"])
    assert np.isfinite(newtons["mae_mn"])
    assert not np.isfinite(scores.get("mae_mn", np.nan))
