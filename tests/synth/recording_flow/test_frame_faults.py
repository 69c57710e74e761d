"""What spoils a film on its way from the camera is found and named, and a film as it came is let be."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from fake_recording import texture
from numpy.typing import NDArray

from synth.recording_flow.frame_faults import VideoFaults, find_bars, is_inside_out


def _film() -> NDArray[np.uint8]:
    """(10, 96, 128, 3): a surface that moves by 2 px a frame, seen by a camera with noise."""
    rng, wide = np.random.default_rng(0), texture(96, 160).astype(np.float32)
    film = np.stack([wide[:, 2 * k : 2 * k + 128] for k in range(10)])
    return np.asarray(np.clip(film + rng.normal(0, 2, film.shape), 0, 255), np.uint8)


def _spoilt(kind: str) -> NDArray[np.uint8]:
    film = _film()
    woven, frozen, late = film.copy(), film.copy(), film.copy()
    woven[:-1, 1::2], frozen[4:7] = film[1:, 1::2], film[3]
    blurred = np.stack([cv2.GaussianBlur(one, (0, 0), 3) for one in film])
    late[5:] = blurred[5:]
    noise = np.random.default_rng(1).normal(0, 30, film.shape)
    blocks = [cv2.imdecode(cv2.imencode(".jpg", one, [cv2.IMWRITE_JPEG_QUALITY, 3])[1], 1) for one in film]
    kinds = {"as it came": film, "interlaced": woven, "again": frozen, "fine detail": blurred, "sharp": late}
    kinds |= {"dim": film // 5, "noisy": np.clip(film + noise, 0, 255).astype(np.uint8)}
    return np.asarray((kinds | {"blocks": np.stack(blocks)})[kind])


@pytest.mark.parametrize(
    "kind", ["as it came", "interlaced", "again", "fine detail", "sharp", "dim", "noisy", "blocks"]
)
def test_what_spoils_a_film_is_named(kind: str) -> None:
    film = _spoilt(kind)
    faults = VideoFaults(film[0], film[0], np.ones(film.shape[1:3], bool))
    for k, picture in enumerate(film[1:], 1):
        faults.see(k, k / 10, picture)
        faults.look(k / 10, picture, picture)
    said = [finding.message for finding in faults.findings()]
    assert any(kind in one for one in said) or (kind == "as it came" and not said)
    assert faults.repeats() == ((dict.fromkeys((4, 5, 6), 3) if kind == "again" else {}), {})


@pytest.mark.parametrize(("jumped", "named"), [("camera", True), ("instrument", False)])
def test_a_bump_is_named_and_an_instrument_that_comes_in_at_once_is_not(jumped: str, named: bool) -> None:
    rng, rest = np.random.default_rng(0), texture(96, 160).astype(np.float32)
    faults = None
    for k in range(10):
        clean = rest[:, 8:136] if jumped == "camera" and k >= 5 else rest[:, :128].copy()
        if jumped == "instrument" and k >= 5:
            clean[20:80, 90:120] = 90  # 15% of the picture
        picture = np.asarray(np.clip(clean + rng.normal(0, 2, clean.shape), 0, 255), np.uint8)
        if faults is None:
            faults = VideoFaults(picture, picture, np.ones((96, 128), bool))
        else:
            faults.see(k, k / 10, picture)
    assert faults is not None
    assert bool(faults.findings()) is named


def test_black_bars_are_no_tissue_and_an_inverted_mask_is_asked_about() -> None:
    boxed = np.full((96, 128, 3), 16, np.uint8)
    boxed[12:-12] = _film()[0, 12:-12]
    assert find_bars(boxed)[:, 0].tolist() == [True] * 12 + [False] * 72 + [True] * 12
    assert not find_bars(_film()[0]).any()
    tissue = np.zeros((96, 128), bool)
    tissue[20:70, 30:100] = True
    assert is_inside_out(~tissue)
    assert not is_inside_out(tissue)
    assert not is_inside_out(np.ones_like(tissue))
