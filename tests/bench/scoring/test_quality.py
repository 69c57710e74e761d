"""Pictures without texture are lost and have no force, rather than 0 mN."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from fake_recording import Maker, scored, texture

from bench.scoring.headline import headline

BLACK = np.zeros((96, 128, 3), np.uint8)


@pytest.mark.parametrize("picture", [BLACK + 3, BLACK + 128, texture(16, 16), texture(96, 128)])
def test_recordings_without_texture_or_motion_have_no_scores(make: Maker, picture: np.ndarray) -> None:
    folder = make(frames=4)
    for k in range(4):
        cv2.imwrite(str(folder / "frames" / f"{k:04d}.png"), picture)
    result = scored(folder, backend="dis")
    assert result.lost.all()
    assert np.isnan(result.methods["bump"].size_mn).all()
    assert headline(result).refused


def test_a_single_black_frame_is_lost(make: Maker) -> None:
    folder = make(frames=8)
    cv2.imwrite(str(folder / "frames" / "0004.png"), BLACK)
    result = scored(folder, backend="dis")
    assert np.flatnonzero(result.lost).tolist() == [4]
    assert headline(result).refused == ""
