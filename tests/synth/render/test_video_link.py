"""The recorder's codec: H.264 at a bitrate."""

import cv2
import numpy as np
import pytest

from synth.job.schema import SensorSection as Section
from synth.render.camera import video_link


@pytest.mark.parametrize("chroma", ["4:2:0", "4:4:4"])
def test_the_codec_loses_more_at_a_lower_bitrate_and_always_the_same(chroma: str) -> None:
    rng = np.random.default_rng(1)
    grey = cv2.GaussianBlur(rng.uniform(0, 255, (48, 66)).astype(np.float32), (0, 0), 1.0)
    base = np.repeat(grey[..., None], 3, axis=2)
    film = np.stack([np.roll(base, t, axis=1) for t in range(6)]).astype(np.uint8)
    errors = []
    for rate in (0.02, 5.0):
        section = Section.model_validate({"bitrate_mbps": rate, "chroma": chroma})
        back = video_link.recorded(film, section, 25.0)
        assert back.shape == film.shape
        assert (back == video_link.recorded(film, section, 25.0)).all()
        errors.append(np.abs(back.astype(int) - film).mean())
    assert errors[1] < 4
    assert errors[0] > 2 * errors[1]


def test_odd_sizes_and_no_codec() -> None:
    film = np.full((3, 33, 35, 3), 90, np.uint8)
    section = Section.model_validate({"bitrate_mbps": 1.0, "chroma": "4:2:0"})
    assert np.abs(video_link.recorded(film, section, 25.0).astype(int) - 90).max() <= 4
    assert video_link.recorded(film, Section(), 25.0) is film
