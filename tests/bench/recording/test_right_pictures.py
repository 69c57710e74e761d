"""A recording's right and depth camera, on a photograph warped by a known motion in three dimensions."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from skimage import data

import bench
import synth
from bench.checks.judgement import judge
from bench.methods.method_interface import ForceEstimate, FrameMotion, MethodContext
from bench.methods.physics import Physics
from bench.recording import recording_writer
from bench.recording.recording_folder import open_recording
from bench.tracking.tracking import TrackedRecording, track_recording
from synth.errors import UserError
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.pair_findings import judge_pair_scale
from synth.flow.recording.right_pictures import PairQuality
from synth.flow.recording.stereo_timing import find_lag
from synth.flow.stereo.stereo_track import Motion3D
from tests.synth.flow.test_stereo import AWAY, BASE, COLUMNS, FOCAL, K_RIGHT, ROWS, K, source

FPS = 6.0
DENT = np.exp(-((COLUMNS - 80) ** 2 + (ROWS - 60) ** 2) / (2 * 22.0**2))
SETTINGS = RecordingFlowSettings(rate_hz=None, pulse=False, masks="none")
CALIBRATION = {"K1": K, "D1": np.zeros(5), "K2": K_RIGHT, "D2": np.zeros(5)}
CALIBRATION |= {"R": np.eye(3), "T": np.array([[-1.0], [0], [0]])}
Make = Callable[..., Path]


def warp_photograph(shift_px: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB: the photograph with its points moved `shift_px` to the right."""
    photograph = cv2.resize(data.astronaut(), (420, 420), interpolation=cv2.INTER_AREA)
    x = source(shift_px) + 60
    return np.asarray(
        cv2.remap(photograph, x.astype(np.float32), (ROWS + 30).astype(np.float32), cv2.INTER_CUBIC)
    )


def rise(amount: float) -> np.ndarray:
    """Motion (H, W) mm of the tissue away from the camera, on the left rest pixels."""
    return np.asarray(FOCAL * BASE / (FOCAL * BASE / AWAY - amount * DENT) - AWAY)


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Frames by the size of the dent and the height of the whole surface, at rest where disparity is 0."""

    def write_pair(
        second: str, dents: Sequence[float] = (0, 0.3, 0.6), lifts: Sequence[float] = (0, 0, 0)
    ) -> Path:
        for name in ("frames", second):
            (tmp_path / name).mkdir()
        for t, (amount, lift) in enumerate(zip(dents, lifts, strict=True)):
            u, depth = 2.5 * amount * DENT, np.float32(AWAY + lift + rise(amount))
            cv2.imwrite(str(tmp_path / f"frames/{t:03d}.png"), warp_photograph(u)[..., ::-1])
            if second == "right":
                d = FOCAL * BASE * (1 / depth - 1 / AWAY)
                cv2.imwrite(str(tmp_path / f"right/{t:03d}.png"), warp_photograph(u - d)[..., ::-1])
            else:
                now = cv2.remap(depth, *map(np.float32, (source(u), ROWS)), cv2.INTER_LINEAR)
                np.save(tmp_path / f"depth/{t:03d}.npy", np.dstack([0 * now, 0 * now, now]) if t else now)
        about: dict[str, object] = {"scale_mm_per_px": AWAY / FOCAL, "young_kpa": 1.0, "fps": FPS}
        about["membrane"] = "stripped"  # fewer tissues to solve
        recording_writer.write_storage(tmp_path / "pair.yaml", CALIBRATION)
        pair = {"calibration": "pair.yaml", "mm_per_unit": BASE}
        about |= {"stereo": pair} if second == "right" else {"depth": {"focal_px": FOCAL}}
        recording_writer.write_meta(tmp_path, about)
        return tmp_path

    return write_pair


class Recorder:
    """A method that stores the motion it is given."""

    def __init__(self) -> None:
        self.inputs: list[Motion3D] = []

    def __call__(self, frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        self.inputs.append(frame.motion)
        return ForceEstimate(frame.motion.motion[50:70, 70:90].mean(axis=(0, 1)).astype(np.float64))


@pytest.mark.parametrize("second", ["right", "depth"])
def test_motion_in_three_dimensions_is_recovered(make: Make, second: str) -> None:
    method = Recorder()
    tracked = track_recording(open_recording(make(second)), {"it": method}, AWAY / FOCAL, SETTINGS)
    assert not method.inputs[0].motion.any()
    inner = (slice(15, -15), slice(15, -15))
    for estimate, amount in zip(method.inputs[1:], (0.3, 0.6), strict=True):
        error = estimate.motion[..., 2] - rise(amount)
        assert rise(amount).max() > 0.75
        assert np.sqrt((error[inner] ** 2).mean()) < 0.12
        assert estimate.motion[60, 80, 2] == pytest.approx(rise(amount)[60, 80], rel=0.15)
        assert estimate.motion[60, 80, 0] == pytest.approx(2.5 * amount * AWAY / FOCAL, abs=0.05)
        assert (estimate.deviation[inner] > 0).all()
    assert tracked.stereo.noise_mm > 0
    assert np.isnan(tracked.stereo.baseline_mm) == (second == "depth")
    if second == "right":
        assert tracked.stereo.baseline_mm == pytest.approx(BASE, rel=1e-3)
        assert tracked.stereo.epipolar_px < 0.1
        assert (tracked.stereo.copied, tracked.stereo.frozen) == (False, 0)


def test_two_cameras_measure_a_scale_that_is_not_stated(make: Make) -> None:
    folder = make("right")
    about = yaml.safe_load((folder / "meta.yaml").read_text("utf-8"))
    del about["scale_mm_per_px"]
    recording_writer.write_meta(folder, about)
    assert open_recording(folder).scale.mm_per_px == pytest.approx(AWAY / FOCAL, rel=0.01)
    tissue = np.where(np.hypot(COLUMNS - 20, ROWS - 100) < 15, np.uint8(255), np.uint8(0))
    cv2.imwrite(str(folder / "tissue.png"), tissue)  # away from the middle
    assert open_recording(folder).scale.mm_per_px == pytest.approx(AWAY / FOCAL, rel=0.01)
    for camera in ("frames", "right"):  # counted from 1, as ffmpeg does
        for file in sorted((folder / camera).iterdir(), reverse=True):
            file.rename(file.with_name(f"{int(file.stem) + 1:03d}.png"))
    assert open_recording(folder).scale.mm_per_px == pytest.approx(AWAY / FOCAL, rel=0.01)
    recording_writer.write_meta(folder, about | {"rest_frame": 7})
    with pytest.raises(UserError, match="frames 7"):
        _ = open_recording(folder).scale
    del about["stereo"]
    recording_writer.write_meta(folder, about)
    with pytest.raises(UserError, match="scale_mm_per_px"):
        open_recording(folder)


@pytest.mark.parametrize(("second", "lost"), [("right", "001.png"), ("depth", "001.npy")])
def test_a_missing_right_or_depth_picture_is_a_gap(make: Make, second: str, lost: str) -> None:
    folder = make(second)
    (folder / second / lost).unlink()
    tracked = track_recording(open_recording(folder), {"it": Recorder()}, AWAY / FOCAL, SETTINGS)
    assert tracked.trusted == [True, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("second", ["right", pytest.param("depth", marks=pytest.mark.trial)])
def test_breathing_along_the_optical_axis_is_removed_from_depth(make: Make, second: str) -> None:
    """The whole surface moves in depth, which one picture hardly shows, and is pressed meanwhile."""
    rate_hz, lift_mm, count = 0.4, 0.5, 72
    time = np.arange(count) / FPS
    load = 0.5 * np.clip(np.sin(np.pi * (time - 5) / 2.5), 0, None) * ((time > 5) & (time < 7.5))
    breath = lift_mm * (np.cos(2 * np.pi * rate_hz * time) - 1)
    recorders, recording = (Recorder(), Recorder()), open_recording(make(second, load, breath))
    stride = 3  # frames, of which the breath is seen without its removal
    for method, pulse, rate in zip(recorders, (False, True), (FPS / stride, None), strict=True):
        settings = replace(SETTINGS, pulse=pulse, rate_hz=rate)
        tracked = track_recording(recording, {"it": method}, AWAY / FOCAL, settings)
    moving, still = (np.array([estimate.motion for estimate in method.inputs]) for method in recorders)
    assert (len(moving), len(still)) == (count / stride, count)
    (rhythm,) = tracked.pulse
    assert rhythm["rate_hz"] == pytest.approx(rate_hz, rel=0.03)
    assert rhythm["amplitude_mm"] == pytest.approx(lift_mm, rel=0.1)
    inner = (slice(1, None), slice(15, -15), slice(15, -15), 2)
    truth = np.stack([rise(amount) for amount in load])
    assert np.sqrt(np.square(moving[inner] - truth[::stride][inner[:3]]).mean()) > 0.5
    assert np.sqrt(np.square(still[inner] - truth[inner[:3]]).mean()) < 0.12
    deepest = int(np.argmax(load))
    assert still[deepest, 60, 80, 2] == pytest.approx(truth[deepest, 60, 80], rel=0.15)


PAIR = PairQuality(BASE, 0.1, AWAY / FOCAL, 0.01)
FAULTS: dict[str, float] = {"copied": True, "frozen": 3, "tool_behind_px": 2.0, "lag_s": -0.1}
FAULTS |= {"epipolar_px": 3.0, "last_rows_px": 1.8}


@pytest.mark.parametrize("fault", FAULTS)
def test_pictures_that_are_no_pair_are_an_error(make: Make, fault: str) -> None:
    recording = open_recording(make("right"))

    def severities(quality: PairQuality) -> set[str]:
        tracked = TrackedRecording(stereo=quality, scale_mm_per_px=AWAY / FOCAL)
        return {finding.severity for finding in judge(recording, tracked) if finding.cause == "stereo"}

    assert severities(PAIR) == {"ok"}
    assert severities(replace(PAIR, noise_mm=0.3)) == {"warning"}
    assert "warning" in severities(replace(PAIR, sharpness=0.5))
    assert "error" in severities(replace(PAIR, **{fault: FAULTS[fault]}))


@pytest.mark.slow
def test_estimate_of_two_videos_is_that_of_their_recording(make: Make) -> None:
    folder, scale = make("right", (0, 0.1, 0.2)), AWAY / FOCAL  # within the linear range
    tracked = track_recording(open_recording(folder), {"physics": Physics()}, scale, SETTINGS)
    about: dict[str, Any] = {"scale_mm_per_px": scale, "young_kpa": 1.0, "masks": "none", "pulse": False}
    about |= {"rate_hz": None, "fps": FPS, "membrane": "stripped"}
    pair = {"right": folder / "right", "calibration": folder / "pair.yaml", "mm_per_unit": BASE}
    stereo = bench.estimate(folder / "frames", **about, **pair)
    assert stereo["force_mn"] == pytest.approx(np.array(tracked.force_mn["physics"]), rel=1e-6)
    monocular = bench.estimate(folder / "frames", **about)
    assert (
        np.linalg.norm(stereo["force_mn"] - monocular["force_mn"], axis=1).max()
        > 0.1 * stereo["total_force_mn"].max()
    )
    other_unit = pair | {"mm_per_unit": 1.0}
    assert not np.isfinite(bench.estimate(folder / "frames", **about, **other_unit)["total_force_mn"]).any()
    for option in pair.keys() - {"mm_per_unit"}:
        with pytest.raises(UserError, match=f"^{option}:"):
            bench.estimate(folder / "frames", **about, **{k: v for k, v in pair.items() if k != option})
    with pytest.raises(UserError, match="scale"):
        bench.estimate(folder / "frames", **(about | {"scale_mm_per_px": "unknown"}), **pair)
    for number in (2, 1, 0):  # counted from 1: matched by their order
        (folder / f"right/{number:03d}.png").rename(folder / f"right/{number + 1:03d}.png")
    renumbered = bench.estimate(folder / "frames", **about, **pair)
    assert renumbered["force_mn"] == pytest.approx(stereo["force_mn"], rel=1e-9)
    measured = bench.estimate(folder / "frames", **(about | {"scale_mm_per_px": None}), **pair)
    assert measured["scale_mm_per_px"] == pytest.approx(scale, rel=0.01)
    assert measured["total_force_mn"] == pytest.approx(stereo["total_force_mn"], rel=0.05, abs=1e-3)
    grey = np.zeros((3, 120, 160), np.uint8)
    with pytest.raises(UserError, match=r"^right: uint8"):
        bench.estimate(folder / "frames", **about, **(pair | {"right": grey}))
    with pytest.raises(UserError, match="right"):
        bench.estimate(next(iter(synth.sample())).path, **pair)


def test_a_baseline_in_metres_is_reported() -> None:
    quality = PairQuality(0.024, 0.1, 0.05e-3, 0.01)
    (finding,) = judge_pair_scale(quality, 0.05)
    assert finding.severity == "error"
    assert {"metres,", "1000"} <= set(finding.message.split())


@pytest.mark.parametrize(
    ("order", "lag"),
    [(lambda k: k, 0), (lambda k: np.maximum(k - 1, 0), 1), (lambda k: np.minimum(k + (k > 9), 23), -1)],
)
def test_a_lag_of_the_right_camera_is_found_by_its_motion(
    order: Callable[[NDArray[np.intp]], NDArray[np.intp]], lag: int
) -> None:
    rng = np.random.default_rng(3)
    rows, frames = np.arange(60), np.arange(24)[:, None]
    place = 5 * frames.clip(0, 6) + 4 * (frames - 18).clip(0)  # moves, rests, moves
    left = 5 * np.exp(-(((rows - place) / 6) ** 2)) * np.diff(place, axis=0, prepend=-5).clip(0, 1)
    left = left + np.sin(frames / 3) ** 2 * np.exp(-(((rows - 30) / 15) ** 2)) + 2
    right = 0.8 * left[order(np.arange(24))] + rng.normal(0, 0.05, left.shape)
    measured_lag, since = find_lag(left + rng.normal(0, 0.05, left.shape), right)
    assert measured_lag == lag
    assert (since > 5) == (lag < 0)
