"""Photographs: usable region, compression, refused files, statistics; recovery of a known camera."""

import io
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from synth.errors import UserError
from synth.fit import fitting
from synth.fit.fitting import fit_colours
from synth.fit.photograph import Compression, Photograph, find_cortex, measure, read_photograph
from synth.render.camera.camera_sensor import process_colours
from synth.render.camera.colour_processing import CAMERAS, encode_srgb

REFERENCE = Path(__file__).parents[4] / "shared" / "reference" / "cortex_photo.jpg"


def draw_scene(width: int = 640, height: int = 480, *, tool: bool = True) -> np.ndarray:
    """An opening of tissue in a bloody rim on a dark blue drape, with a steel rod across it (H, W, 3)."""
    rng = np.random.default_rng(0)
    picture = np.full((height, width, 3), (20, 25, 60), np.uint8)
    centre = (width // 2, height // 2)
    cv2.circle(picture, centre, round(0.46 * height), (130, 25, 20), -1)
    cv2.circle(picture, centre, round(0.38 * height), (240, 205, 160), -1)
    for angle in np.linspace(0, np.pi, 9)[:-1]:
        reach = 0.36 * height * np.array([np.cos(angle), np.sin(angle)])
        ends = [tuple(np.rint(np.array(centre) + sign * reach).astype(int).tolist()) for sign in (-1, 1)]
        cv2.line(picture, ends[0], ends[1], (200, 70, 55), 3)
    if tool:
        cv2.line(picture, (width, height), (width // 2 + 40, height // 2 + 30), (150, 152, 155), 26)
    return np.clip(picture + rng.normal(0, 3, picture.shape), 0, 255).astype(np.uint8)


def draw_opening(width: int = 640, height: int = 480) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.asarray(np.hypot(x - width // 2, y - height // 2) < 0.38 * height)


def write_picture(path: Path, rgb: np.ndarray, **settings: object) -> Path:
    Image.fromarray(rgb).save(path, **settings)
    return path


def test_the_opening_is_detected_without_the_instrument() -> None:
    with_tool, truth = find_cortex(draw_scene(), 0.08), draw_opening()
    rod = np.zeros(truth.shape, np.uint8)
    cv2.line(rod, (640, 480), (360, 270), 1, 20)
    rod = (rod > 0) & truth
    assert (with_tool & rod).sum() < 0.1 * rod.sum()
    assert (with_tool & ~truth).sum() < 0.03 * truth.sum()
    assert (with_tool & truth).sum() > 0.6 * (truth & ~rod).sum()
    assert (find_cortex(draw_scene(tool=False), 0.08) & truth).sum() > 0.8 * truth.sum()


def test_the_compression_of_a_jpeg_is_read_and_reproduced() -> None:
    rgb = draw_scene()
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, "JPEG", quality=60, subsampling="4:2:0")
    compression = Compression.of_file(buffer.getvalue(), 1.0)
    assert compression.chroma == "4:2:0"
    jpeg = np.asarray(Image.open(io.BytesIO(buffer.getvalue())))
    assert np.abs(compression.apply(rgb).astype(int) - jpeg).mean() < 0.05


def test_unusable_photographs_are_refused(tmp_path: Path) -> None:
    dark_photo = write_picture(tmp_path / "dark.png", np.zeros((300, 400, 3), np.uint8))
    small_photo = write_picture(tmp_path / "small.png", draw_scene(200, 150))
    photo = write_picture(tmp_path / "photo.png", draw_scene())
    mask = write_picture(tmp_path / "mask.png", np.zeros((300, 400), np.uint8))
    for path, mask_path in (
        (dark_photo, None),
        (small_photo, None),
        (photo, mask),
        (tmp_path / "none.jpg", None),
    ):
        with pytest.raises(UserError):
            read_photograph(path, 35.0, mask_path)


@pytest.mark.skipif(not REFERENCE.exists(), reason="the reference photograph is missing")
def test_the_cortex_of_the_reference_photograph_is_detected(tmp_path: Path) -> None:
    photo = Path(shutil.copy(REFERENCE, tmp_path / "photo.jpg"))
    photograph = read_photograph(photo, 110.0, None)
    assert 1200 < photograph.cortex_mm2 < 2400, "the opening is some 55 mm wide"
    red, green = (photograph.rgb[..., k][photograph.usable].astype(float) for k in range(2))
    assert np.mean(green < 0.42 * red) < 0.15, "little of it is blood"


MM = 0.0547
SIZE = (360, 480)


def draw_vessels(count: int, width_px: int) -> np.ndarray:
    """Linear light of tissue with a little grain, crossed by horizontal red vessels, (H, W, 3)."""
    grain = 1 + 0.01 * np.random.default_rng(0).standard_normal(SIZE)
    picture = np.array([0.8, 0.6, 0.4]) * grain[..., None]
    for y in np.linspace(20, SIZE[0] - 20, count).astype(int):
        cv2.line(picture, (0, int(y)), (SIZE[1], int(y)), (0.75, 0.12, 0.08), width_px)
    return picture


def test_noise_of_known_size_is_found_and_blur_lowers_sharpness() -> None:
    picture = np.clip(np.rint(255 * encode_srgb(draw_vessels(8, 3))), 0, 255)
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
    video = np.clip(process_colours(light[None], *camera)[0], 0, 1)
    fitted_video = np.clip(process_colours(light[None], *fit_colours(light, video)[0])[0], 0, 1)
    default_video = np.clip(process_colours(light[None], *CAMERAS[0])[0], 0, 1)
    assert np.abs(fitted_video - video).mean() < 0.3 * np.abs(default_video - video).mean()


@pytest.mark.slow
@pytest.mark.trial
def test_the_camera_of_a_photograph_of_another_brain_is_recovered() -> None:
    # Healthy, pale and oedematous tissue differ less than anatomies do, once the camera's colours are free.
    frame = fitting.render("hyperaemic", 400, MM, 7)
    rgb = frame.record({"vignette": 0.4, "blur": 1.0, "full_well": 3000.0, "read_noise": 6.0})
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, "JPEG", quality=90, subsampling="4:2:0")
    compression = Compression.of_file(buffer.getvalue(), 1.0)
    fit = fitting.fit_camera(Photograph(np.asarray(Image.open(buffer)), frame.usable, MM, compression))
    assert fit["appearance"]["families"] == ["hyperaemic"]
    sensor = fit["sensor"]
    assert sensor["vignette"] == pytest.approx(0.4, abs=0.15)
    assert sensor["blur_px"] == pytest.approx(1.0, abs=0.25)
    assert sensor["full_well"] == pytest.approx(3000, rel=0.6)
    assert sensor["chroma"] == "4:2:0"
    assert sensor["bitrate_mbps"] > 1
