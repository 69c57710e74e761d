"""Fused loops of the renderer's pictures against the array expressions that they stand for, byte by byte."""

import cv2
import numpy as np
import pytest

from synth.geometry.triangles import lengths
from synth.render.camera import camera_sensor
from synth.render.camera.camera_sensor import CameraSensor, record

MATRIX = ((1.3, -0.2, -0.1), (-0.2, 1.4, -0.2), (0.0, -0.5, 1.5))
RNG = np.random.default_rng(4)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_lengths_are_those_of_norm(kind: type) -> None:
    vectors = RNG.normal(size=(50, 40, 3)).astype(kind)
    assert np.array_equal(lengths(vectors), np.linalg.norm(vectors, axis=-1))
    assert lengths(vectors).dtype == kind


def test_the_sensor_is_the_chain_of_its_parts() -> None:
    radiance = (1.3 * RNG.random((60, 80, 3)) ** 2).astype(np.float32)
    sensor = CameraSensor(white=(1.1, 1.0, 0.8), bloom=0.0, vignette=0.0, matrix=MATRIX)
    least = np.float32(0.8)
    electrons = radiance * (least * np.float32(sensor.exposure)) * np.float32(sensor.full_well)
    drawn = np.random.default_rng(1).standard_normal(electrons.shape, dtype=np.float32)
    electrons = electrons + drawn * np.sqrt(electrons + np.float32(sensor.read_noise**2))
    steps = np.float32(2**sensor.bits - 1) / np.float32(2)
    digital = np.rint(np.clip(electrons / np.float32(sensor.full_well), 0, 2) * steps) / steps
    balanced = np.clip(digital * (np.asarray(sensor.white, np.float32) / least), 0, 2)
    mixed = np.clip(np.einsum("kc,hwc->hwk", np.array(MATRIX, np.float32), balanced), 0, 2)
    table = camera_sensor._table(sensor.curves[0])
    video = np.interp(mixed, np.linspace(0, 2, len(table)), table).astype(np.float32)
    video = video + sensor.sharpening * (video - cv2.GaussianBlur(video, (0, 0), 1.0))
    wanted = np.rint(np.clip(video, 0, 1) * 255).astype(np.uint8)
    off = record(radiance, sensor, np.random.default_rng(1)).astype(int) - wanted
    assert abs(off).max() <= 1, "sums of three products round in another order"
    assert (off != 0).mean() < 1e-3
