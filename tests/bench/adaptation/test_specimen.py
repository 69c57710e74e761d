"""A recording's rest frame as texture and job: light comes off, the tissue keeps its place and scale."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fake_recording import Maker, texture
from numpy.typing import NDArray

from bench.adaptation import rest_texture
from bench.adaptation.specimen_job import specimen_job
from bench.recording.folder import open_recording
from synth.errors import UserError
from synth.fit.statistics import decode

Map = NDArray[Any]


def test_light_comes_off_and_what_is_hidden_is_filled() -> None:
    rng = np.random.default_rng(0)
    height, width, pitch = 120, 160, 0.25
    albedo = 0.4 + 0.1 * cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), 2)[..., None] * 8
    albedo = np.repeat(np.clip(albedo, 0.1, 0.9), 3, axis=2)
    x = np.linspace(-1, 1, width)
    lit = albedo * (0.9 - 0.4 * x**2)[None, :, None]  # slow across the picture
    rgb = np.rint(255 * lit ** (1 / 2.2)).astype(np.uint8)
    rgb[40:60, 70:90] = 0  # a tool
    usable = np.ones((height, width), bool)
    usable[40:60, 70:90] = False
    colour = np.full(3, 0.4, np.float32)
    made = decode(rest_texture.unroll(rgb, usable, pitch, 50.0, colour))
    assert made.shape == (200, 200, 3)  # 50 mm at 0.25 mm a pixel
    assert made.mean() == pytest.approx(0.4, rel=0.05)
    assert made.min() > 0.05  # nothing of the tool
    edges = [np.r_[one[:20], one[-20:]].mean() / one[60:100].mean() for one in _columns(albedo, lit, made)]
    true, recorded, found = edges
    assert recorded < 0.75 * true
    assert found == pytest.approx(true, rel=0.15)


def _columns(albedo: Map, lit: Map, made: Map) -> Iterator[Map]:
    """Mean of each column, of the picture's part of each."""
    for one in (albedo, lit, made[40:160, 20:180]):
        yield np.delete(one, slice(40, 60), axis=0).mean(axis=(0, 2))


def test_a_job_has_the_recordings_scale_eyes_and_codec(make: Maker, tmp_path: Path) -> None:
    size = (240, 320)
    folder = make(frames=4, size=size, footage="mp4", meta={"scale_mm_per_px": 0.1})
    job = specimen_job(open_recording(folder), 50, tmp_path / "rest.png")
    assert job.sequences == 50
    assert job.render.size == (320, 240)
    assert np.mean(job.render.field_mm) == pytest.approx(32.0)
    assert job.render.stereo_mm == 0
    assert job.sensor.bitrate_mbps is not None
    # Tissue from edge to edge: no rim in sight.
    assert job.anatomy.craniotomy.radius_mm > np.hypot(32, 24) / 2
    assert job.appearance.photo == tmp_path / "rest.png"
    # The same recording, the same job: an interrupted run goes on.
    assert specimen_job(open_recording(folder), 50, tmp_path / "rest.png") == job


def test_a_rest_frame_without_tissue_is_refused(make: Maker, tmp_path: Path) -> None:
    folder = make(frames=3, size=(240, 320))
    cv2.imwrite(str(folder / "mask.png"), np.full((240, 320), 255, np.uint8))
    with pytest.raises(UserError):
        specimen_job(open_recording(folder), 50, tmp_path / "rest.png")


def test_texture_is_of_the_picture(make: Maker, tmp_path: Path) -> None:
    """The middle of the texture is the middle of the picture, pixel for pixel."""
    rgb = texture(120, 160)
    usable = np.ones((120, 160), bool)
    made = rest_texture.unroll(rgb, usable, 0.25, 50.0, np.full(3, 0.4, np.float32))
    one, other = (cv2.cvtColor(a, cv2.COLOR_RGB2GRAY).astype(np.float64) for a in (rgb, made[40:160, 20:180]))
    assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.9
