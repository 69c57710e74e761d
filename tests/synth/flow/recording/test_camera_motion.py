"""Camera motion estimated on the surroundings of the tissue."""

import numpy as np
import pytest
from numpy.typing import NDArray

from synth.flow.confidence import add_deviation, deviation, of_deviation
from synth.flow.recording.camera_path import CameraTracker
from synth.flow.recording.decode import Footage, RecordingFlowSettings
from synth.flow.recording.video_pass import VideoPass
from synth.video.read_video import Picture

HEIGHT, WIDTH = 120, 160
Y, X = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
OPENING = np.hypot(X - 80, Y - 60) < 40
EVERYWHERE = np.ones((HEIGHT, WIDTH), bool)
Places = tuple[NDArray[np.float64], NDArray[np.float64]]


def texture(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(H, W, 3) an analytic picture: waves of 6 to 25 px."""
    rng = np.random.default_rng(0)
    waves = [rng.uniform(6, 25) for _ in range(40)]
    turns, phases = rng.uniform(0, 2 * np.pi, (2, 40))
    components = zip(waves, turns, phases, strict=True)
    grey = sum(
        np.cos(2 * np.pi * (np.cos(a) * x + np.sin(a) * y) / wavelength + p)
        for wavelength, a, p in components
    )
    return np.clip(128 + 12 * np.asarray(grey), 0, 255).astype(np.uint8)[..., None].repeat(3, -1)


def move_camera(dx: float, dy: float, scale: float = 1.0, degrees: float = 0.0) -> Places:
    """Positions in the rest frame that the pixels of a moved camera show."""
    c, s = np.cos(np.radians(degrees)) / scale, np.sin(np.radians(degrees)) / scale
    x, y = X - 80 - dx, Y - 60 - dy
    return c * x + s * y + 80, -s * x + c * y + 60


@pytest.mark.parametrize("motion", [(3, 4), (0.4, -0.3), (0, 0, 1.03), (0, 0, 1, 2), (18, -11, 1.02, -1)])
def test_a_similarity_is_estimated_and_undone(motion: tuple[float, ...]) -> None:
    rest, now = texture(X, Y), texture(*move_camera(*motion))
    similarity = CameraTracker(rest, OPENING, ~EVERYWHERE).find(now, 1.0)
    assert similarity is not None
    positions = np.stack(move_camera(*motion))
    restored = (
        np.einsum("ij,jhw->ihw", similarity.matrix[:, :2], positions) + similarity.matrix[:, 2, None, None]
    )
    assert np.hypot(*(restored - np.stack([X, Y])))[OPENING].max() < 0.06
    inside = ~similarity.outside(EVERYWHERE.shape)
    assert np.abs(similarity.undo(now).astype(int) - rest)[inside].mean() < 1
    assert similarity.deviation_px < 0.05


@pytest.mark.parametrize("tissue", [OPENING, None], ids=["opening", "everywhere"])
def test_a_camera_bump_is_removed_from_the_motion_and_reported(tissue: NDArray[np.bool_] | None) -> None:
    pictures = [Picture(t, t / 8, texture(*move_camera(0, 5 * (t > 2)))) for t in range(6)]
    settings = RecordingFlowSettings("dis", 1, None, False, "none")
    read_tissue = None if tissue is None else lambda size: tissue
    video = VideoPass(Footage(lambda: pictures, "video", read_tissue), settings)
    frames, inside = list(video.frames()), EVERYWHERE if tissue is None else tissue
    assert all(
        np.array_equal(frame.rgb, picture.rgb)
        for frame, picture in zip(frames[:3], pictures[:3], strict=True)
    )
    assert max(np.median(np.abs(frame.flow[inside])) for frame in frames) < 0.05
    assert all(frame.trusted for frame in frames)
    # The pictures have no noise and are therefore reported as repeated too.
    (finding,) = [finding for finding in video.findings if finding.cause == "camera"]
    assert finding.severity == "warning"
    assert all(part in finding.message for part in ("5 px", "0.375 s"))


def test_confidence_includes_the_deviation_of_the_camera() -> None:
    flow_deviation = np.array([[0.1, 0.3, 1.0]], np.float32)
    total = deviation(add_deviation(of_deviation(flow_deviation), 0.4))
    assert total == pytest.approx(np.hypot(flow_deviation, 0.4), rel=1e-4)
    assert not add_deviation(np.zeros((1, 1), np.float32), 0.4).any()


def test_tissue_outside_the_mask_is_not_taken_for_camera_motion() -> None:
    pull_px = 1.5 / (1 + np.hypot(X - 80, Y - 60) / 20)
    frames = texture(X, Y), texture(X - pull_px, Y - 0.3 * pull_px)
    tissue = np.hypot(X - 80, Y - 60) < 30
    similarity = CameraTracker(frames[0], tissue, ~EVERYWHERE).find(frames[1], 1.0)
    assert similarity is None or similarity.length_px < 0.3
