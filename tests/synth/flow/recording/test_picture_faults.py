"""Faults of videos are detected and named; a clean video has none."""

import cv2
import numpy as np
import pytest
from fake_recording import texture
from numpy.typing import NDArray

from synth.flow.recording.picture_faults import VideoFaults, find_bars, is_inside_out


def _video() -> NDArray[np.uint8]:
    """(10, 96, 128, 3): a surface that moves by 2 px per frame, with sensor noise."""
    rng, wide = np.random.default_rng(0), texture(96, 160).astype(np.float32)
    video = np.stack([wide[:, 2 * k : 2 * k + 128] for k in range(10)])
    return np.asarray(np.clip(video + rng.normal(0, 2, video.shape), 0, 255), np.uint8)


def _corrupted() -> dict[str, NDArray[np.uint8]]:
    """Videos by the fault in them."""
    video = _video()
    woven, frozen, late, stale = (video.copy() for _ in range(4))
    woven[:-1, 1::2], frozen[4:7] = video[1:, 1::2], video[3]
    stale[4:7] = np.clip(video[3] + np.random.default_rng(2).normal(0, 1, video[:3].shape), 0, 255)
    blurred = np.stack([cv2.GaussianBlur(one, (0, 0), 3) for one in video])
    late[5:] = blurred[5:]
    noise = np.random.default_rng(1).normal(0, 30, video.shape)
    blocks = [cv2.imdecode(cv2.imencode(".jpg", one, [cv2.IMWRITE_JPEG_QUALITY, 3])[1], 1) for one in video]
    kinds = {"clean": video, "interlaced": woven, "again": frozen, "fine detail": blurred, "sharp": late}
    kinds |= {"previous one again": stale, "dim": video // 5, "blocks": np.stack(blocks)}
    return kinds | {"noisy": np.clip(video + noise, 0, 255).astype(np.uint8)}


@pytest.mark.parametrize(("kind", "video"), _corrupted().items(), ids=list(_corrupted()))
def test_faults_of_a_video_are_named(kind: str, video: NDArray[np.uint8]) -> None:
    faults = VideoFaults(video[0], video[0], np.ones(video.shape[1:3], bool))
    for k, picture in enumerate(video[1:], 1):
        faults.add_decoded(k, k / 10, picture)
        faults.add_tracked(k / 10, picture, picture)
    messages = [finding.message for finding in faults.findings()]
    assert any(kind in one for one in messages) or (kind == "clean" and not messages)
    assert faults.repeats() == ((dict.fromkeys((4, 5, 6), 3) if "again" in kind else {}), {})


@pytest.mark.parametrize(("jumped", "reported"), [("camera", True), ("instrument", False)])
def test_a_bump_is_reported_and_an_instrument_that_enters_at_once_is_not(jumped: str, reported: bool) -> None:
    rng, rest = np.random.default_rng(0), texture(96, 160).astype(np.float32)
    pictures = []
    for k in range(10):
        clean = rest[:, 8:136] if jumped == "camera" and k >= 5 else rest[:, :128].copy()
        if jumped == "instrument" and k >= 5:
            clean[20:80, 90:120] = 90  # 15% of the picture
        pictures.append(np.asarray(np.clip(clean + rng.normal(0, 2, clean.shape), 0, 255), np.uint8))
    faults = VideoFaults(pictures[0], pictures[0], np.ones((96, 128), bool))
    for k, picture in enumerate(pictures[1:], 1):
        faults.add_decoded(k, k / 10, picture)
    assert bool(faults.findings()) is reported


def test_black_bars_and_inverted_masks_are_detected() -> None:
    boxed = np.full((96, 128, 3), 16, np.uint8)
    boxed[12:-12] = _video()[0, 12:-12]
    assert find_bars(boxed)[:, 0].tolist() == [True] * 12 + [False] * 72 + [True] * 12
    assert not find_bars(_video()[0]).any()
    tissue = np.pad(np.ones((50, 70), bool), ((20, 26), (30, 28)))
    assert is_inside_out(~tissue)
    assert not is_inside_out(tissue)
    assert not is_inside_out(np.ones_like(tissue))


def test_a_stream_that_changes_its_size_is_followed() -> None:
    """A recorder that switches its mode: pictures of one size after the other, there and back."""
    small = _video()
    large = np.pad(small, ((0, 0), (0, 24), (0, 32), (0, 0)))
    faults = VideoFaults(small[0], small[0], np.ones(small.shape[1:3], bool))
    for k, picture in enumerate([*small[1:5], *large[5:8], *small[8:]], 1):
        faults.add_decoded(k, k / 10, picture)
    assert faults.repeats() == ({}, {})
