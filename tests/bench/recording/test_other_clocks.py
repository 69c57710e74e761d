"""Times since 1970, rotated sensors, and unknown scales."""

from pathlib import Path

import numpy as np
import pytest
from fake_recording import Maker, force_curve, scored
from scipy.spatial.transform import Rotation

from bench.checks.check_recording import check_recording
from bench.recording import writer

EPOCH = 1.7e9


def since_1970(folder: Path, frames: int, stamped: str = "both") -> None:
    time = np.arange(frames) / 10
    t = np.arange(0, time[-1] + 1e-9, 0.01)
    writer.write_frames(folder, time + EPOCH * (stamped != "force"))
    newtons = np.outer(force_curve(t) / 1000, [1.0, 0.0, 0.0])
    writer.write_force(folder, t + EPOCH * (stamped != "frames"), newtons)


def test_times_since_1970_are_counted_from_the_start(make: Maker) -> None:
    spans = {"press_s": [EPOCH + 0.2, EPOCH + 1.0], "sensor": {"free_s": [[EPOCH, EPOCH + 0.15]]}}
    stamped = make("stamped", frames=20, meta=spans)
    since_1970(stamped, 20)
    plain = make("plain", frames=20, meta={"press_s": [0.2, 1.0], "sensor": {"free_s": [[0.0, 0.15]]}})
    one, other = scored(stamped), scored(plain)
    assert one.time_s == pytest.approx(other.time_s, abs=1e-5)
    assert one.scored.tolist() == other.scored.tolist()
    errors = [result.methods["bump"].scores["mae_mn"] for result in (one, other)]
    assert errors[0] == pytest.approx(errors[1], abs=1e-3)
    severities = {f.cause: f.severity for f in check_recording(stamped)}
    assert (severities["clocks"], severities["spans"]) == ("ok", "ok")


@pytest.mark.parametrize("stamped", ["frames", "force"])
def test_a_single_clock_since_1970_is_not_scored(make: Maker, stamped: str) -> None:
    folder = make(frames=6)
    since_1970(folder, 6, stamped)
    assert scored(folder).methods["bump"].scores == {}


def test_a_rotated_sensor_is_converted_to_the_cameras_axes(make: Maker) -> None:
    turn = Rotation.from_euler("xyz", [40, -25, 70], degrees=True).as_matrix()
    about = {"sensor": {"axes": "sensor", "to_camera": turn.tolist(), "low_pass_hz": None}}
    folder = make(frames=12, meta=about)
    t = np.arange(0, 1.11, 0.01)
    in_camera = np.outer(force_curve(t) / 1000, [1.0, 0.0, 0.0])
    writer.write_force(folder, t, in_camera @ turn)  # R^T f, as rows
    result = scored(folder)
    assert result.sensor_axes_mn is not None
    assert result.sensor_axes_mn[:, 0] == pytest.approx(force_curve(np.arange(12) / 10), abs=0.5)
    assert np.abs(result.sensor_axes_mn[:, 1:]).max() < 1e-3
    assert set(result.methods["bump"].components) == {"x", "y", "z"}


def test_unknown_scale_gives_relative_forces(make: Maker) -> None:
    one = scored(make("one", frames=20, meta={"scale_mm_per_px": "unknown", "young_kpa": 1.0}))
    known = scored(make("two", frames=20, meta={"scale_mm_per_px": 32 / 128, "young_kpa": 1.0}))
    assert one.scale.mm_per_px == known.scale.mm_per_px
    assert known.absolute
    assert not one.absolute
    scores, newtons = one.methods["bump"].scores, known.methods["bump"].scores
    assert scores["r"] == pytest.approx(newtons["r"])
    assert np.isfinite(newtons["mae_mn"])
    assert not np.isfinite(scores.get("mae_mn", np.nan))
