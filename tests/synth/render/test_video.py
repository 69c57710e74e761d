"""From chip to recorder: mosaic, thinned colour, H.264, and noise measured on frames."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from evidence.render import photon_transfer
from synth.errors import UserError
from synth.job.schema import Sensor as Section
from synth.render.camera import video
from synth.render.camera.camera_sensor import Sensor, record

PLAIN = Sensor(vignette=0.0, bloom=0.0, contrast=0.0, sharpening=0.0, full_well=1e7, read_noise=0.0)


def scene(size: int = 64) -> np.ndarray:
    """A smooth picture with a red line on it."""
    y, x = np.mgrid[:size, :size] / size
    light = np.stack([0.3 + 0.3 * x, 0.3 + 0.2 * y, 0.2 + 0.2 * x * y], -1)
    light[:, size // 2] = [0.7, 0.05, 0.05]
    return light.astype(np.float32)


def test_a_mosaic_keeps_smooth_colours_and_smears_fine_ones() -> None:
    whole, mosaic = (
        record(scene(), replace(PLAIN, bayer=bayer), np.random.default_rng(0)).astype(int)
        for bayer in (False, True)
    )
    away = np.abs(whole - mosaic)
    assert away[4:-4, 4:24].max() <= 3
    assert away[4:-4, 31:34].max() > 20


def test_thinned_chroma_keeps_brightness() -> None:
    full, half = (
        cv2.cvtColor(record(scene(), replace(PLAIN, chroma=c), np.random.default_rng(0)), cv2.COLOR_RGB2YCrCb)
        for c in ("4:4:4", "4:2:0")
    )
    away = np.abs(full.astype(int) - half)[4:-4, 28:37]
    assert away[..., 0].max() <= 3
    assert away[..., 1].max() > 15


def test_before_a_codec_colours_are_left_to_it_and_the_sensor_says_so() -> None:
    section = Section.model_validate({"bitrate_mbps": 5.0, "chroma": "4:2:0"})
    sensor = Sensor.draw(section, (1.0, 1.0, 1.0), np.random.default_rng(0))
    assert sensor.chroma == "4:2:0"
    coded, full = (
        record(scene(), replace(PLAIN, chroma=chroma, coded=coded), np.random.default_rng(0))
        for chroma, coded in ((sensor.chroma, sensor.coded), ("4:4:4", False))
    )
    assert np.array_equal(coded, full)


@pytest.mark.parametrize(("chroma", "depth"), [("4:2:0", 8), ("4:4:4", 10)])
def test_the_codec_loses_more_at_a_lower_bitrate_and_always_the_same(chroma: str, depth: int) -> None:
    rng = np.random.default_rng(1)
    grey = cv2.GaussianBlur(rng.uniform(0, 255, (48, 66)).astype(np.float32), (0, 0), 1.0)
    base = np.repeat(grey[..., None], 3, axis=2)
    film = np.stack([np.roll(base, t, axis=1) for t in range(6)]).astype(np.uint8)
    errors = []
    for rate in (0.02, 5.0):
        section = Section.model_validate({"bitrate_mbps": rate, "chroma": chroma, "depth": depth})
        back = video.recorded(film, section, 25.0)
        assert back.shape == film.shape
        assert (back == video.recorded(film, section, 25.0)).all()
        errors.append(np.abs(back.astype(int) - film).mean())
    assert errors[1] < 4
    assert errors[0] > 2 * errors[1]


def test_odd_sizes_and_no_codec() -> None:
    film = np.full((3, 33, 35, 3), 90, np.uint8)
    section = Section.model_validate({"bitrate_mbps": 1.0, "chroma": "4:2:0"})
    assert np.abs(video.recorded(film, section, 25.0).astype(int) - 90).max() <= 4
    assert video.recorded(film, Section(), 25.0) is film


def shots(gain: float, read: float, black: float, levels: list[float]) -> np.ndarray:
    """12-bit frames of a camera with that gain [electrons a grey level] and readout noise [electrons]."""
    rng = np.random.default_rng(2)
    uneven = rng.uniform(0.9, 1.1, (120, 120))
    frames = [rng.poisson(level * uneven) + rng.normal(0, read, uneven.shape) for level in levels]
    return np.rint(np.stack(frames) / gain + black).clip(0, 4095)


def test_the_noise_of_a_known_camera_is_found() -> None:
    flats = shots(4.0, 9.0, 64.0, [1000, 1000, 4000, 4000, 12000, 12000])
    darks = shots(4.0, 9.0, 64.0, [0, 0, 0])
    found = photon_transfer.fit(flats, darks, 4095)
    assert found.gain == pytest.approx(4.0, rel=0.05)
    assert found.read_noise == pytest.approx(9.0, rel=0.05)
    assert found.full_well == pytest.approx(4.0 * (4095 - 64), rel=0.05)
    assert found.black == pytest.approx(64, abs=0.1)


@pytest.mark.parametrize("levels", [[0, 0], [40_000, 40_000], [1000, 4000]])
def test_frames_that_say_nothing_are_refused(levels: list[float]) -> None:
    with pytest.raises(UserError, match="flat frames"):
        photon_transfer.fit(shots(4.0, 9.0, 64.0, levels), shots(4.0, 9.0, 64.0, [0, 0]), 4095)


def test_a_folder_without_two_pictures_is_named(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(UserError, match="two are needed"):
            photon_transfer.load(path)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4), np.uint16))
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((4, 4), np.uint8))
    with pytest.raises(UserError, match="differ"):
        photon_transfer.load(tmp_path)
