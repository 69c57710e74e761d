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
    each = zip(waves, turns, phases, strict=True)
    grey = sum(np.cos(2 * np.pi * (np.cos(a) * x + np.sin(a) * y) / long + p) for long, a, p in each)
    return np.clip(128 + 12 * np.asarray(grey), 0, 255).astype(np.uint8)[..., None].repeat(3, -1)


def moved(dx: float, dy: float, scale: float = 1.0, degrees: float = 0.0) -> Places:
    """Positions in the rest frame that the pixels of a moved camera show."""
    c, s = np.cos(np.radians(degrees)) / scale, np.sin(np.radians(degrees)) / scale
    x, y = X - 80 - dx, Y - 60 - dy
    return c * x + s * y + 80, -s * x + c * y + 60


@pytest.mark.parametrize("motion", [(3, 4), (0.4, -0.3), (0, 0, 1.03), (0, 0, 1, 2), (18, -11, 1.02, -1)])
def test_a_similarity_is_estimated_and_undone(motion: tuple[float, ...]) -> None:
    rest, now = texture(X, Y), texture(*moved(*motion))
    found = CameraTracker(rest, OPENING, ~EVERYWHERE).find(now, 1.0)
    assert found is not None
    there = np.stack(moved(*motion))
    back = np.einsum("ij,jhw->ihw", found.matrix[:, :2], there) + found.matrix[:, 2, None, None]
    assert np.hypot(*(back - np.stack([X, Y])))[OPENING].max() < 0.06
    inside = ~found.outside(EVERYWHERE.shape)
    assert np.abs(found.undo(now).astype(int) - rest)[inside].mean() < 1
    assert found.deviation_px < 0.05


@pytest.mark.parametrize("tissue", [OPENING, None], ids=["opening", "everywhere"])
def test_a_camera_bump_is_removed_from_the_motion_and_reported(tissue: NDArray[np.bool_] | None) -> None:
    pictures = [Picture(t, t / 8, texture(*moved(0, 5 * (t > 2)))) for t in range(6)]
    settings = RecordingFlowSettings("dis", 1, None, False, "none")
    stated = None if tissue is None else lambda size: tissue
    video = VideoPass(Footage(lambda: pictures, "video", stated), settings)
    frames, inside = list(video.frames()), EVERYWHERE if tissue is None else tissue
    assert all(np.array_equal(one.rgb, two.rgb) for one, two in zip(frames[:3], pictures[:3], strict=True))
    assert max(np.median(np.abs(one.flow[inside])) for one in frames) < 0.05
    assert all(one.trusted for one in frames)
    # The pictures have no noise and are therefore reported as repeated too.
    (finding,) = [one for one in video.findings if one.cause == "camera"]
    assert finding.severity == "warning"
    assert all(part in finding.message for part in ("5 px", "0.375 s"))


def test_confidence_includes_the_deviation_of_the_camera() -> None:
    own = np.array([[0.1, 0.3, 1.0]], np.float32)
    both = deviation(add_deviation(of_deviation(own), 0.4))
    assert both == pytest.approx(np.hypot(own, 0.4), rel=1e-4)
    assert not add_deviation(np.zeros((1, 1), np.float32), 0.4).any()


def test_tissue_outside_the_mask_is_not_taken_for_camera_motion() -> None:
    pulled = 1.5 / (1 + np.hypot(X - 80, Y - 60) / 20)
    frames = texture(X, Y), texture(X - pulled, Y - 0.3 * pulled)
    part = np.hypot(X - 80, Y - 60) < 30
    found = CameraTracker(frames[0], part, ~EVERYWHERE).find(frames[1], 1.0)
    assert found is None or found.length_px < 0.3
