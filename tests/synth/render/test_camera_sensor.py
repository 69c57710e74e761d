"""The sensor's noise and transfer against closed forms, its fused loops, and the recorder's codec."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from synth.job.schema import SensorSection
from synth.render.camera import camera_sensor
from synth.render.camera.camera_sensor import CameraSensor, process_colours, record
from synth.render.camera.colour_processing import CAMERAS, KNOTS, encode_srgb
from synth.render.camera.colour_processing import PLAIN as ORDINARY
from synth.render.camera.video_link import transmit

SRGB = (tuple(encode_srgb(np.array(KNOTS)).tolist()),) * 3
PLAIN = CameraSensor(vignette=0.0, bloom=0.0, curves=SRGB, sharpening=0.0)
NOISELESS = replace(PLAIN, full_well=1e9, read_noise=0.0, bits=30)
MATRIX = ((1.3, -0.2, -0.1), (-0.2, 1.4, -0.2), (0.0, -0.5, 1.5))
RNG = np.random.default_rng(4)


def make_flat(level: float, side: int = 200) -> np.ndarray:
    return np.full((side, side, 3), level, np.float32)


def record_light(light: np.ndarray, sensor: CameraSensor) -> np.ndarray:
    """Linear light (H, W, 3) of the picture."""
    srgb = record(light, sensor, np.random.default_rng(0)) / 255
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("level", [0.1, 0.4, 0.8])
def test_noise_is_photons_and_readout(level: float) -> None:
    sensor = replace(PLAIN, full_well=500.0, read_noise=6.0)
    light = record_light(make_flat(level), sensor)
    expected = np.sqrt(level * 500 + 36) / 500
    assert light.std() == pytest.approx(expected, rel=0.05)
    assert light.mean() == pytest.approx(level, rel=0.02)


def test_white_balance_multiplies_channels() -> None:
    light = record_light(make_flat(0.4), replace(NOISELESS, white=(1.5, 1.0, 0.5))).mean(axis=(0, 1))
    np.testing.assert_allclose(light, [0.6, 0.4, 0.2], rtol=0.02)


def test_what_fills_the_sensor_is_white_under_any_lamp() -> None:
    sensor = replace(PLAIN, white=(0.79, 1.0, 1.26))
    for curves in (SRGB, ORDINARY.curves):
        assert (record(make_flat(5.0), replace(sensor, curves=curves), np.random.default_rng(0)) == 255).all()


def test_a_matrix_mixes_linear_light_and_keeps_white() -> None:
    sensor = replace(NOISELESS, matrix=MATRIX)
    colour = make_flat(1.0) * np.array([0.5, 0.3, 0.2], np.float32)
    expected = np.array(sensor.matrix) @ [0.5, 0.3, 0.2]
    np.testing.assert_allclose(record_light(colour, sensor).mean(axis=(0, 1)), expected, rtol=0.02)
    np.testing.assert_allclose(record_light(make_flat(0.4), sensor), 0.4, rtol=0.02)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_camera_keeps_its_knots_and_rises_between_them_not_steeply_in_the_dark(camera: tuple) -> None:
    matrix, curves = camera
    np.testing.assert_allclose(np.sum(matrix, axis=1), 1, atol=1e-3)
    levels = np.linspace(0, KNOTS[-1], 4001)
    grey = np.repeat(levels.astype(np.float32)[None, :, None], 3, axis=2)
    video = process_colours(grey, ORDINARY.matrix, curves)[0]
    assert (np.diff(video, axis=0) >= -1e-6).all()
    for k in range(3):
        np.testing.assert_allclose(np.interp(KNOTS, levels, video[:, k]), curves[k], atol=2e-3)
    dark = levels < KNOTS[0]
    slope = np.diff(video[dark], axis=0) / np.diff(encode_srgb(levels[dark]))[:, None]
    assert slope.max() < 1.3, "of plain sRGB: a steeper one multiplies the noise"


def test_bloom_keeps_the_light() -> None:
    spot = np.zeros((101, 101, 3), np.float32)
    spot[50, 50] = 0.5
    sharp_light = record_light(spot, NOISELESS)
    bloomed_light = record_light(spot, replace(NOISELESS, bloom=0.4))
    assert bloomed_light[50, 50, 0] < 0.75 * sharp_light[50, 50, 0]
    assert bloomed_light[52, 50, 0] > sharp_light[52, 50, 0]


def test_corners_lose_the_given_share() -> None:
    light = record_light(make_flat(0.5, 201), replace(NOISELESS, vignette=0.3))[..., 0]
    assert light[0, 0] / light[100, 100] == pytest.approx(0.7, rel=0.03)


def test_blur_widens_an_edge_by_its_own_width() -> None:
    edge = np.zeros((64, 128, 3), np.float32)
    edge[:, 64:] = 0.5
    light = record_light(edge, replace(NOISELESS, blur=2.0))[32, :, 1] / 0.5
    # A Gaussian's edge rises from 15.9 to 84.1% over two of its standard deviations.
    low, high = np.interp([0.1587, 0.8413], light[54:75], np.arange(54, 75))
    assert (high - low) / 2 == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("chroma", ["4:2:0", "4:4:4"])
def test_the_codec_is_deterministic_and_loses_more_at_a_lower_bitrate(chroma: str) -> None:
    rng = np.random.default_rng(1)
    grey = cv2.GaussianBlur(rng.uniform(0, 255, (48, 66)).astype(np.float32), (0, 0), 1.0)
    base = np.repeat(grey[..., None], 3, axis=2)
    video = np.stack([np.roll(base, t, axis=1) for t in range(6)]).astype(np.uint8)
    errors = []
    for rate in (0.02, 5.0):
        section = SensorSection.model_validate({"bitrate_mbps": rate, "chroma": chroma})
        decoded_video = transmit(video, 25.0, section.bitrate_mbps, section.chroma)
        assert decoded_video.shape == video.shape
        assert (decoded_video == transmit(video, 25.0, section.bitrate_mbps, section.chroma)).all()
        errors.append(np.abs(decoded_video.astype(int) - video).mean())
    assert errors[1] < 4
    assert errors[0] > 2 * errors[1]


def test_odd_sizes_and_no_codec() -> None:
    video = np.full((3, 33, 35, 3), 90, np.uint8)
    section = SensorSection.model_validate({"bitrate_mbps": 1.0, "chroma": "4:2:0"})
    assert np.abs(transmit(video, 25.0, section.bitrate_mbps, section.chroma).astype(int) - 90).max() <= 4
    assert transmit(video, 25.0, None) is video


def test_the_sensor_is_the_chain_of_its_parts() -> None:
    radiance = (1.3 * RNG.random((60, 80, 3)) ** 2).astype(np.float32)
    sensor = CameraSensor(white=(1.1, 1.0, 0.8), bloom=0.0, vignette=0.0, matrix=MATRIX)
    least_white = np.float32(0.8)
    electrons = radiance * (least_white * np.float32(sensor.exposure)) * np.float32(sensor.full_well)
    noise = np.random.default_rng(1).standard_normal(electrons.shape, dtype=np.float32)
    electrons = electrons + noise * np.sqrt(electrons + np.float32(sensor.read_noise**2))
    steps = np.float32(2**sensor.bits - 1) / np.float32(2)
    digital = np.rint(np.clip(electrons / np.float32(sensor.full_well), 0, 2) * steps) / steps
    balanced = np.clip(digital * (np.asarray(sensor.white, np.float32) / least_white), 0, 2)
    mixed = np.clip(np.einsum("kc,hwc->hwk", np.array(MATRIX, np.float32), balanced), 0, 2)
    table = camera_sensor._table(sensor.curves[0])
    video = np.interp(mixed, np.linspace(0, 2, len(table)), table).astype(np.float32)
    video = video + sensor.sharpening * (video - cv2.GaussianBlur(video, (0, 0), 1.0))
    expected = np.rint(np.clip(video, 0, 1) * 255).astype(np.uint8)
    difference = record(radiance, sensor, np.random.default_rng(1)).astype(int) - expected
    assert abs(difference).max() <= 1, "sums of three products round in another order"
    assert (difference != 0).mean() < 1e-3


def test_light_that_is_no_number_is_black() -> None:
    light = np.array([[[np.nan] * 3, [0.5] * 3, [-np.inf] * 3]], np.float32)
    video = process_colours(light, *CAMERAS[0])
    assert np.isfinite(video).all()
    assert (video[0, [0, 2]] == 0).all()
    assert (video[0, 1] > 0).all()
