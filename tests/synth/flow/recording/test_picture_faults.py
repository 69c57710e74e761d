"""Faults of videos are detected and named; a clean video has none."""

import cv2
import numpy as np
import pytest
from fake_recording import texture
from numpy.typing import NDArray

from synth.flow.recording.picture_faults import VideoFaults, find_bars, is_inside_out


def _make_video() -> NDArray[np.uint8]:
    """(10, 96, 128, 3): a surface that moves by 2 px per frame, with sensor noise."""
    rng, panorama = np.random.default_rng(0), texture(96, 160).astype(np.float32)
    video = np.stack([panorama[:, 2 * k : 2 * k + 128] for k in range(10)])
    return np.asarray(np.clip(video + rng.normal(0, 2, video.shape), 0, 255), np.uint8)


def _corrupt_videos() -> dict[str, NDArray[np.uint8]]:
    """Videos by the fault in them."""
    video = _make_video()
    interlaced_video, frozen_video, late_blur_video, repeated_video = (video.copy() for _ in range(4))
    interlaced_video[:-1, 1::2], frozen_video[4:7] = video[1:, 1::2], video[3]
    repeated_video[4:7] = np.clip(video[3] + np.random.default_rng(2).normal(0, 1, video[:3].shape), 0, 255)
    blurred_video = np.stack([cv2.GaussianBlur(frame, (0, 0), 3) for frame in video])
    late_blur_video[5:] = blurred_video[5:]
    noise = np.random.default_rng(1).normal(0, 30, video.shape)
    blocks = [
        cv2.imdecode(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 3])[1], 1) for frame in video
    ]
    videos = {
        "clean": video,
        "interlaced": interlaced_video,
        "again": frozen_video,
        "fine detail": blurred_video,
        "sharp": late_blur_video,
    }
    videos |= {"previous one again": repeated_video, "dim": video // 5, "blocks": np.stack(blocks)}
    return videos | {"noisy": np.clip(video + noise, 0, 255).astype(np.uint8)}


@pytest.mark.parametrize(("kind", "video"), _corrupt_videos().items(), ids=list(_corrupt_videos()))
def test_faults_of_a_video_are_named(kind: str, video: NDArray[np.uint8]) -> None:
    faults = VideoFaults(video[0], video[0], np.ones(video.shape[1:3], bool))
    for k, picture in enumerate(video[1:], 1):
        faults.add_decoded(k, k / 10, picture)
        faults.add_tracked(k / 10, picture, picture)
    messages = [finding.message for finding in faults.findings()]
    assert any(kind in message for message in messages) or (kind == "clean" and not messages)
    assert faults.repeats() == ((dict.fromkeys((4, 5, 6), 3) if "again" in kind else {}), {})


@pytest.mark.parametrize(("jump", "reported"), [("camera", True), ("instrument", False)])
def test_a_bump_is_reported_and_an_instrument_that_enters_at_once_is_not(jump: str, reported: bool) -> None:
    rng, rest = np.random.default_rng(0), texture(96, 160).astype(np.float32)
    pictures = []
    for k in range(10):
        clean_picture = rest[:, 8:136] if jump == "camera" and k >= 5 else rest[:, :128].copy()
        if jump == "instrument" and k >= 5:
            clean_picture[20:80, 90:120] = 90  # 15% of the picture
        pictures.append(
            np.asarray(np.clip(clean_picture + rng.normal(0, 2, clean_picture.shape), 0, 255), np.uint8)
        )
    faults = VideoFaults(pictures[0], pictures[0], np.ones((96, 128), bool))
    for k, picture in enumerate(pictures[1:], 1):
        faults.add_decoded(k, k / 10, picture)
    assert bool(faults.findings()) is reported


def test_black_bars_and_inverted_masks_are_detected() -> None:
    boxed_picture = np.full((96, 128, 3), 16, np.uint8)
    boxed_picture[12:-12] = _make_video()[0, 12:-12]
    assert find_bars(boxed_picture)[:, 0].tolist() == [True] * 12 + [False] * 72 + [True] * 12
    assert not find_bars(_make_video()[0]).any()
    tissue = np.pad(np.ones((50, 70), bool), ((20, 26), (30, 28)))
    assert is_inside_out(~tissue)
    assert not is_inside_out(tissue)
    assert not is_inside_out(np.ones_like(tissue))


def test_a_stream_that_changes_its_size_is_followed() -> None:
    """A recorder that switches its mode: pictures of one size after the other, there and back."""
    small_video = _make_video()
    large_video = np.pad(small_video, ((0, 0), (0, 24), (0, 32), (0, 0)))
    faults = VideoFaults(small_video[0], small_video[0], np.ones(small_video.shape[1:3], bool))
    for k, picture in enumerate([*small_video[1:5], *large_video[5:8], *small_video[8:]], 1):
        faults.add_decoded(k, k / 10, picture)
    assert faults.repeats() == ({}, {})
