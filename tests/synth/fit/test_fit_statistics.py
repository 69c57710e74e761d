"""Statistics of drawn pictures with known parameters, and recovery of a known camera."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from synth.fit import fitting
from synth.fit.fitting import fit_colours
from synth.fit.photograph import Compression, Photograph, measure
from synth.render.camera.camera_sensor import processed
from synth.render.camera.colour_processing import CAMERAS, encoded

MM = 0.0547
SIZE = (360, 480)


def lines(count: int, width_px: int) -> np.ndarray:
    """Linear light of tissue with a little grain, crossed by horizontal red vessels, (H, W, 3)."""
    grain = 1 + 0.01 * np.random.default_rng(0).standard_normal(SIZE)
    picture = np.array([0.8, 0.6, 0.4]) * grain[..., None]
    for y in np.linspace(20, SIZE[0] - 20, count).astype(int):
        cv2.line(picture, (0, int(y)), (SIZE[1], int(y)), (0.75, 0.12, 0.08), width_px)
    return picture


def test_noise_of_known_size_is_found_and_blur_lowers_sharpness() -> None:
    picture = np.clip(np.rint(255 * encoded(lines(8, 3))), 0, 255)
    noise = 3 * np.random.default_rng(1).standard_normal(SIZE)[..., None]
    usable = np.ones(SIZE, bool)
    noisy = np.clip(picture + noise, 0, 255).astype(np.uint8)
    assert measure(noisy, usable)["noise"] == pytest.approx(3, rel=0.15)
    sharp = measure(picture.astype(np.uint8), usable)
    soft = measure(cv2.GaussianBlur(picture, (0, 0), 1.5).astype(np.uint8), usable)
    assert soft["sharpness"] < 0.7 * sharp["sharpness"]
    assert soft["noise"] < sharp["noise"]


def test_colours_of_the_same_tissue_are_recovered() -> None:
    rng = np.random.default_rng(2)
    blood = rng.random((9000, 1)) ** 2
    light = np.array([0.95, 0.8, 0.5]) * np.exp(-blood * [0.3, 1.9, 2.3]) * rng.uniform(0.5, 1.1, (9000, 1))
    camera, light = CAMERAS[3], light.astype(np.float32)
    video = np.clip(processed(light[None], *camera)[0], 0, 1)
    found = np.clip(processed(light[None], *fit_colours(light, video)[0])[0], 0, 1)
    before = np.clip(processed(light[None], *CAMERAS[0])[0], 0, 1)
    assert np.abs(found - video).mean() < 0.3 * np.abs(before - video).mean()


@pytest.mark.slow
@pytest.mark.trial
def test_the_camera_of_a_photograph_of_another_brain_is_recovered() -> None:
    frame = fitting.render("pale", 400, MM, 7)
    rgb = frame.record({"vignette": 0.4, "blur": 1.0, "full_well": 3000.0, "read_noise": 6.0})
    packed = io.BytesIO()
    Image.fromarray(rgb).save(packed, "JPEG", quality=90, subsampling="4:2:0")
    compression = Compression.of_file(packed.getvalue(), 1.0)
    found = fitting.fit_camera(Photograph(np.asarray(Image.open(packed)), frame.usable, MM, compression))
    assert found["appearance"]["families"] == ["pale"]
    sensor = found["sensor"]
    assert sensor["vignette"] == pytest.approx(0.4, abs=0.15)
    assert sensor["blur_px"] == pytest.approx(1.0, abs=0.25)
    assert sensor["full_well"][0] == pytest.approx(3000, rel=0.6)
    assert sensor["chroma"] == "4:2:0"
    assert sensor["bitrate_mbps"] > 1
