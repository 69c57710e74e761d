"""Camera motion where tissue fills the picture, separated from contacts and pulsation of analytic motion."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from synth.arrays import Mask, Pixels
from synth.flow.recording.camera_path import CameraPath, Similarity, SimilarityBasis
from synth.flow.recording.decode import Footage, RecordingFlowSettings
from synth.flow.recording.find_pulse import SurfaceMotion
from synth.flow.recording.flow import LocalFlow
from synth.flow.recording.frame_motion import FrameMotion
from synth.flow.recording.shared_motion import SharedMotion, find_path
from synth.flow.recording.video_pass import VideoPass
from synth.flow.recording.video_track import FrameFile, track_video
from synth.flow.stereo.stereo_track import Motion3D
from synth.video.read_video import Picture
from tests.synth.flow.recording.test_camera_motion import (
    EVERYWHERE,
    HEIGHT,
    WIDTH,
    X,
    Y,
    move_camera,
    texture,
)

FRAMES = 24
TIME = np.arange(1, FRAMES) / 8
BASIS = SimilarityBasis((HEIGHT, WIDTH))
POSITIONS = np.column_stack([X.ravel(), Y.ravel()])
CONFIDENCE = np.ones((HEIGHT, WIDTH), np.float32)
Motion = Callable[[int], tuple[float, ...]]


def step_camera(after: int, *motion: float) -> Motion:
    """A camera that moves once."""
    return lambda frame: motion if frame > after else (0.0, 0.0, 0.0, 0.0)


BUMP, ZOOM, TURN = step_camera(9, 3, -4, 0, 0), step_camera(9, 0, 0, 2.4, 0), step_camera(6, 0, 0, 0, -2.8)


def drift(frame: int) -> tuple[float, ...]:
    return (3 * np.sin(frame / 2), 4 * np.sin(frame / 3), 0.3 * np.sin(frame / 5), 0.5 * np.sin(frame / 4))


def compute_drag(px: float) -> NDArray[np.float64]:
    """(H, W, 2) motion by a tangential load on a disc of 10 px: outside, that of a point (Cerruti, 1882)."""
    x, y, nu = X - 60, Y - 70, 0.48
    r = np.maximum(np.hypot(x, y), 10)
    return px * np.dstack([(1 - nu) / r + nu * x**2 / r**3, nu * x * y / r**3]) * 10


def press(frame: int) -> float:
    """Two presses, with rests between them."""
    return max(0.0, float(np.sin(2 * np.pi * (frame - 3) / 12))) if frame > 3 else 0.0


def film(camera: Motion, px: float) -> tuple[SurfaceMotion, list[NDArray[np.float64]]]:
    """Noisy motion over a video, and the matrices of the camera."""
    rng, surface, matrices = np.random.default_rng(1), SurfaceMotion(EVERYWHERE), []
    for frame, time_s in zip(range(1, FRAMES), TIME, strict=True):
        positions = np.dstack([X, Y]) + compute_drag(px * press(frame))
        matrix = BASIS.matrix(np.array(camera(frame)))
        flow = positions @ matrix[:, :2].T + matrix[:, 2] - np.dstack([X, Y])
        surface.add(time_s, (flow + rng.normal(0, 0.3, flow.shape)).astype(np.float32), CONFIDENCE)
        matrices.append(matrix)
    return surface, matrices


def measure_error_px(similarity: Similarity | None, matrix: NDArray[np.float64]) -> float:
    difference = (np.eye(2, 3) if similarity is None else similarity.matrix) - matrix
    return float(np.sqrt(np.square(POSITIONS @ difference[:, :2].T + difference[:, 2]).sum(axis=1).mean()))


@pytest.mark.parametrize("px", [0.0, 0.5, 3.0, 10.0])
def test_a_contact_is_not_taken_for_camera_motion(px: float) -> None:
    assert find_path(film(step_camera(FRAMES), px)[0], None) is None


@pytest.mark.parametrize("camera", [BUMP, ZOOM, TURN])
@pytest.mark.parametrize("px", [0.5, 3.0, 8.0])
def test_camera_motion_is_separated_from_a_contact(camera: Motion, px: float) -> None:
    surface, matrices = film(camera, px)
    path = find_path(surface, None)
    errors_px = [
        measure_error_px(path.at(time_s), matrix) for time_s, matrix in zip(TIME, matrices, strict=True)
    ]
    assert max(errors_px) < 0.1
    # A stream uses past frames only.
    shared = SharedMotion(EVERYWHERE)
    frames = zip(surface.time_s, surface.motion, surface.visible, strict=True)
    similarities = [shared.add(time_s, motion, visible) for time_s, motion, visible in frames]
    assert (
        np.mean([measure_error_px(*pair) for pair in zip(similarities, matrices, strict=True)])
        < 0.05 * px + 0.05
    )


@pytest.mark.parametrize("px", [0.5, 3.0])
def test_the_deviation_of_a_drift_under_a_contact_covers_its_error(px: float) -> None:
    surface, matrices = film(drift, px)
    path = find_path(surface, None)
    rest_frames = [frame for frame in range(1, FRAMES) if not press(frame)]
    errors_px = np.array(
        [
            measure_error_px(similarity, matrix)
            for similarity, matrix in zip(path.similarities, matrices, strict=True)
        ]
    )
    deviations_px = np.array(
        [0.0 if similarity is None else similarity.deviation_px for similarity in path.similarities]
    )
    assert errors_px[np.array(rest_frames) - 1].max() < 0.1
    assert (errors_px < 2 * deviations_px + 0.05).all()
    assert errors_px.max() < 0.25 * px + 0.1


def test_between_frames_a_path_has_the_last_position() -> None:
    similarity = Similarity(np.eye(2, 3))
    path = CameraPath(np.array([1.0, 2.0]), (None, similarity))
    assert [path.at(time_s) for time_s in (0.5, 1.5, 2.0, 9.0)] == [None, None, similarity, similarity]


def make_footage(shift_px: NDArray[np.float64]) -> Footage:
    pictures = [Picture(t, t / 10, texture(*move_camera(0, y))) for t, y in enumerate(shift_px)]
    return Footage(lambda: pictures, "video")


SETTINGS = RecordingFlowSettings("dis", 1, None, True, "none")


def test_pulsation_is_not_taken_for_camera_motion() -> None:
    time_s = np.arange(70) / 10
    pulse = 1.5 * np.sin(2 * np.pi * 0.9 * time_s)
    video = VideoPass(make_footage(pulse), SETTINGS)
    assert np.median(list(video.frames())[3].flow, axis=(0, 1))[1] == pytest.approx(pulse[3], abs=0.1)
    search = video.search()
    assert search.camera is None
    assert search.pulse.rhythms[0].rate_hz == pytest.approx(0.9, abs=0.03)


def test_the_bump_of_a_recording_is_removed_in_a_second_pass() -> None:
    shift = np.where(np.arange(12) > 4, 5.0, 0.0)

    def measure_vertical(frames: Iterable[FrameMotion]) -> list[float]:
        return [float(np.median(frame.flow, axis=(0, 1))[1]) for frame in frames]

    first_pass = VideoPass(make_footage(shift), SETTINGS)
    raw_px = measure_vertical(first_pass.frames())
    with track_video(make_footage(shift), SETTINGS) as track:
        kept_px, second_pass = measure_vertical(track.frames()), track.video
    assert track.search is not None
    corrected_px = measure_vertical(VideoPass(make_footage(shift), SETTINGS, track.search.camera).frames())
    assert raw_px[-1] == pytest.approx(5, abs=0.1)
    assert np.abs(corrected_px).max() < 0.05
    np.testing.assert_allclose(kept_px, corrected_px, atol=1e-3)
    assert [
        [finding.cause for finding in video.findings].count("camera") for video in (first_pass, second_pass)
    ] == [0, 1]


def test_a_pulsating_video_is_decoded_and_its_flow_computed_once() -> None:
    time_s = np.arange(70) / 10
    pulse = 1.5 * np.sin(2 * np.pi * 0.9 * time_s)
    decoded_frames, solved_frames = [], []

    class CountingFlow(LocalFlow):
        def submit(self, rgb: Pixels, masked: Mask) -> Future[FrameMotion]:
            solved_frames.append(len(solved_frames))
            return super().submit(rgb, masked)

    masked_footage = replace(make_footage(pulse), tissue=lambda size: np.ones(size, bool))
    with track_video(masked_footage, SETTINGS, flow=CountingFlow(), progress=decoded_frames.append) as track:
        shifts = [np.median(frame.flow, axis=(0, 1))[1] for frame in track.frames()]
        second_shifts = [np.median(frame.flow, axis=(0, 1))[1] for frame in track.frames()]
    assert track.removed is not None
    assert decoded_frames == list(range(1, 71))
    assert len(solved_frames) == 69
    assert np.abs(shifts).max() < 0.15
    assert shifts == second_shifts


def test_frames_are_kept_within_the_rounding_that_is_stated() -> None:
    rng = np.random.default_rng(0)
    flow = rng.normal(scale=30, size=(40, 60, 2)).astype(np.float32)
    motion, deviation = rng.normal(size=(2, 40, 60, 3)).astype(np.float32)
    mask, rgb = rng.random((40, 60)) > 0.5, rng.integers(0, 255, (40, 60, 3), dtype=np.uint8)
    frame = FrameMotion(
        flow, np.abs(motion[..., 0]), masked=mask, motion=Motion3D(motion, deviation), index=7, rgb=rgb
    )
    file = FrameFile()
    file.add(frame)
    file.add(replace(frame, motion=None, masked=None, trusted=False))
    for _ in range(2):
        first_frame, second_frame = file.read()
        np.testing.assert_allclose(first_frame.flow, flow, rtol=2.0**-13)
        np.testing.assert_allclose(first_frame.motion.motion, motion, rtol=2.0**-13)
        np.testing.assert_array_equal(first_frame.masked, mask)
        np.testing.assert_array_equal(first_frame.rgb, rgb)
        assert (first_frame.index, first_frame.trusted, first_frame.tool) == (7, True, None)
        assert (second_frame.motion, second_frame.masked, second_frame.trusted) == (None, None, False)
    file.close()
