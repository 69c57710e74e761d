"""Tissue found in videos of analytic motion: an opening in still surroundings, and tissue everywhere."""

from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from synth.flow.recording.decode import Footage, RecordingFlowSettings
from synth.flow.recording.find_tissue import TissueSearch, measure_border_share
from synth.flow.recording.frame_motion import FrameMotion, RestFrame
from synth.flow.recording.video_track import track_video
from synth.video.read_video import Picture
from tests.synth.flow.recording.test_camera_motion import EVERYWHERE, OPENING, X, Y, texture

SETTINGS = RecordingFlowSettings("dis", 1, None, False, "none")
RIM = np.clip(1 - np.hypot(X - 80, Y - 60) / 40, 0, 1)  # motion falls to 0 at the rim


def video(opening: NDArray[np.bool_], rim: NDArray[np.float64], px: float, bump: int) -> Footage:
    """A load at (70, 60) drags the tissue by up to `px` and lets go; the surroundings have another colour."""
    rng = np.random.default_rng(0)
    pull = rim * np.minimum(1, 10 / np.maximum(np.hypot(X - 70, Y - 60), 1e-6))

    def draw_picture(frame: int) -> Picture:
        drag = px * np.sin(np.pi * frame / 8) ** 2 * pull
        rgb = texture(X - drag, Y) * np.array([1.0, 0.7, 0.6])
        rgb[~opening] = (texture(Y, X) * np.array([0.6, 0.8, 1.0]))[~opening]
        rgb = np.roll(rgb, bump * (frame > 5), axis=0) + rng.normal(0, 1, rgb.shape)
        return Picture(frame, frame / 8, np.clip(rgb, 0, 255).astype(np.uint8))

    return Footage(partial(map, draw_picture, range(12)), "video")


CASES = {
    "opening": (OPENING, RIM, 4, 0),
    "moved camera": (OPENING, RIM, 4, 3),
    "edge to edge": (EVERYWHERE, EVERYWHERE, 4, 0),
    "gentle contact": (EVERYWHERE, EVERYWHERE, 0.4, 0),
    "nothing moves": (EVERYWHERE, EVERYWHERE, 0, 0),
}


@pytest.mark.parametrize("case", CASES)
def test_tissue_is_found(case: str) -> None:
    video_pass = track_video(video(*CASES[case]), SETTINGS).video
    truth, severity = CASES[case][0], "warning" if case == "gentle contact" else "missing"
    tissue = video_pass.rest.tissue
    assert (tissue & truth).sum() / (tissue | truth).sum() > 0.9
    assert [finding.severity for finding in video_pass.rest.findings] == [severity]
    assert video_pass.rest.findings[0].cause == "tissue"


SHAKE_PX = (0, 3, -2, 4, 1, -4, 2, -3, 4, 0, -2, 3)


@pytest.mark.parametrize("shake", [0, 1], ids=["nothing moves", "all moves alike"])
@pytest.mark.parametrize("opening", [OPENING, EVERYWHERE], ids=["opening", "edge to edge"])
def test_colour_alone_shows_a_rim_or_none(opening: NDArray[np.bool_], shake: int) -> None:
    """Where motion can't: nothing moves, or all of the picture alike."""
    still = video(opening, RIM, 0, 0)
    rest = next(iter(still.pictures())).rgb
    search = TissueSearch(RestFrame(rest, EVERYWHERE, X.shape, 1, 0.0, ""))
    confidence = np.full(X.shape, 0.99, np.float32)
    for frame, px in enumerate(SHAKE_PX):
        flow = np.full((*X.shape, 2), shake * px, np.float32)
        search.add(FrameMotion(flow, confidence, is_rest=frame == 0))
    tissue, finding = search.find()
    assert (tissue & opening).sum() / (tissue | opening).sum() > 0.9
    assert finding.severity == ("missing" if opening is EVERYWHERE else "warning")


def test_a_blob_is_held_back() -> None:
    """What alone moves is a small disc, as an instrument is: no force is stated on it."""
    disc = np.hypot(X - 70, Y - 60) < 16
    video_pass = track_video(video(disc, disc.astype(float), 4, 0), SETTINGS).video
    assert video_pass.rest.tissue.mean() < 0.05
    assert [finding.severity for finding in video_pass.rest.findings] == ["error"]
    assert "tissue.png" in video_pass.rest.findings[0].message


def test_a_part_that_an_instrument_cuts_off_and_often_hides_belongs_to_the_tissue() -> None:
    rng = np.random.default_rng(0)
    rgb = texture(X, Y) * np.array([1.0, 0.7, 0.6])
    rgb[~OPENING] = (texture(Y, X) * np.array([0.6, 0.8, 1.0]))[~OPENING]
    blade = (X > 72) & (X < 86)
    rgb[blade] = 150
    picture = np.clip(rgb + rng.normal(0, 1, rgb.shape), 0, 255).astype(np.uint8)
    search = TissueSearch(RestFrame(picture, EVERYWHERE, X.shape, 1, 0.0, ""))
    zero_flow = np.zeros((*X.shape, 2), np.float32)
    confidence = np.where(blade, 0, 0.99).astype(np.float32)
    search.add(FrameMotion(zero_flow, confidence, is_rest=True, masked=blade))
    for frame in range(10):
        flow = np.stack([3 * (frame + 1) / 10 * RIM + 0.3 * OPENING, 0 * RIM], -1).astype(np.float32)
        left_side = OPENING & (X <= 72)
        # Lost in every other frame.
        frame_confidence = np.where(left_side & (frame % 2 == 0), 0.1, confidence).astype(np.float32)
        search.add(FrameMotion(flow, frame_confidence, masked=blade))
    tissue, finding = search.find()
    assert (tissue & OPENING).sum() / (tissue | OPENING).sum() > 0.85
    assert finding.severity == "missing"


def test_the_border_of_the_picture_is_no_edge() -> None:
    assert measure_border_share(EVERYWHERE) == 1
    assert measure_border_share(OPENING) == 0
    assert measure_border_share(X < 80) == pytest.approx(278 / 396)
