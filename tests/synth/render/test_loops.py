"""Fused loops of the renderer's pictures against the array expressions that they stand for, byte by byte."""

import cv2
import numpy as np
import pytest

from synth.flow import mask
from synth.geometry.triangles import lengths
from synth.render.anatomy import noise, texture
from synth.render.camera import camera_sensor
from synth.render.camera.camera_sensor import Sensor, record

RNG = np.random.default_rng(4)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_lengths_are_those_of_norm(kind: type) -> None:
    vectors = RNG.normal(size=(50, 40, 3)).astype(kind)
    assert np.array_equal(lengths(vectors), np.linalg.norm(vectors, axis=-1))
    assert lengths(vectors).dtype == kind


def test_a_map_in_rows_is_the_map_at_once() -> None:
    one, two = RNG.random((37, 20), np.float32), RNG.random((37, 20, 3), np.float32)

    def paint(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.exp(-a[..., None] * b), a + np.float32(1)

    for found, wanted in zip(noise.in_rows(paint, one, two), paint(one, two), strict=True):
        assert np.array_equal(found, wanted)


def test_the_sensor_is_the_chain_of_its_parts() -> None:
    radiance = (1.3 * RNG.random((60, 80, 3)) ** 2).astype(np.float32)
    sensor = Sensor(white=(1.1, 1.0, 0.8), bloom=0.0, vignette=0.0)
    least = np.float32(0.8)
    electrons = radiance * (least * np.float32(sensor.exposure)) * np.float32(sensor.full_well)
    drawn = np.random.default_rng(1).standard_normal(electrons.shape, dtype=np.float32)
    electrons = electrons + drawn * np.sqrt(electrons + np.float32(sensor.read_noise**2))
    steps = np.float32(2**sensor.bits - 1) / np.float32(2)
    digital = np.rint(np.clip(electrons / np.float32(sensor.full_well), 0, 2) * steps) / steps
    balanced = np.clip(digital * (np.asarray(sensor.white, np.float32) / least), 0, 2)
    video = camera_sensor._tone(balanced, sensor.contrast, sensor.knee)
    video = video + sensor.sharpening * (video - cv2.GaussianBlur(video, (0, 0), 1.0))
    wanted = np.rint(np.clip(video, 0, 1) * 255).astype(np.uint8)
    assert np.array_equal(record(radiance, sensor, np.random.default_rng(1)), wanted)


def test_the_tone_curve_is_read_between_its_points() -> None:
    levels = np.linspace(0, 2, 8193, dtype=np.float32)
    curve = camera_sensor._tone(levels.reshape(-1, 1, 1).repeat(3, 2), 0.35, 0.8)[:, 0, 0].astype(np.float64)
    light = 2 * RNG.random((30, 40, 3), np.float32)
    assert camera_sensor._tone(light, 0.35, 0.8) == pytest.approx(np.interp(light, levels, curve), abs=1e-6)


def test_normals_of_a_height_map_are_unit_vectors_across_its_slope() -> None:
    axis = noise.centres(64, 8.0)
    height = np.broadcast_to(0.5 * axis, (64, 64)).astype(np.float32)
    assert texture.normals(height, 8.0)[8:-8, 8:-8] == pytest.approx(
        np.broadcast_to(np.array([-0.5, 0.0, 1.0]) / 1.25**0.5, (48, 48, 3)), abs=1e-6
    )


def test_a_pixel_with_two_clipped_channels_is_glare_and_with_one_is_not() -> None:
    rgb = np.full((40, 40, 3), 100, np.uint8)
    rgb[10, 10], rgb[30, 30] = (250, 100, 250), (100, 250, 100)
    found = mask.glare(rgb, 0)
    assert found[10, 10]
    assert not found[30, 30]
