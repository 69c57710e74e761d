"""The camera model against OpenCV and against itself."""

import cv2
import numpy as np
import pytest

from synth.errors import UserError
from synth.job.schema import RenderSection
from synth.render.camera import camera
from synth.sequence import scenario

STRONG = (-0.3, 0.2, 0.01, -0.02, 0.1)


def seen(distortion: tuple[float, ...], seed: int = 3) -> camera.Camera:
    render = RenderSection(size=(160, 120), distortion=distortion, field_mm=(150.0, 150.0))
    return camera.place(scenario.draw_view(render, np.random.default_rng(seed)), render)


def test_projection_is_opencvs() -> None:
    lens = seen(STRONG)
    points = np.random.default_rng(0).uniform(-40, 40, (500, 3))
    rotation, _ = cv2.Rodrigues(lens.rotation)
    theirs, _ = cv2.projectPoints(points, rotation, lens.translation, lens.K, lens.distortion)
    np.testing.assert_allclose(camera.project(lens, points), theirs[:, 0], atol=1e-9)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.05, 0.01, 0.0, 0.0, 0.0), STRONG])
def test_a_ray_comes_back_to_its_pixel(distortion: tuple[float, ...]) -> None:
    lens = seen(distortion)
    pixels = camera.pixel_grid(lens.size)
    there = lens.centre + 280 * camera.rays(lens, pixels) @ lens.rotation
    np.testing.assert_allclose(camera.project(lens, there), pixels, atol=1e-8)


def test_it_looks_at_the_craniotomy_from_its_distance_and_tilt() -> None:
    render = RenderSection(tilt_deg=(15.0, 15.0), working_distance_mm=(300.0, 300.0), field_mm=(35.0, 35.0))
    lens = camera.place(scenario.draw_view(render, np.random.default_rng(1)), render)
    np.testing.assert_allclose(camera.project(lens, np.zeros((1, 3)))[0], [319.5, 239.5])
    assert np.linalg.norm(lens.centre) == pytest.approx(300)
    assert np.degrees(np.arccos(lens.centre[2] / 300)) == pytest.approx(15)
    np.testing.assert_allclose(lens.rotation @ lens.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(lens.rotation) == pytest.approx(1)
    # The field's width lies across the picture.
    ends = camera.rays(lens, np.array([[-0.5, 239.5], [639.5, 239.5]]))
    width = 300 * (ends[1, 0] / ends[1, 2] - ends[0, 0] / ends[0, 2])
    assert width == pytest.approx(35, rel=1e-3)


def test_a_distortion_that_folds_the_picture_is_refused() -> None:
    with pytest.raises(UserError):
        camera.rays(seen((-9.0, 0.0, 0.0, 0.0, 0.0)), camera.pixel_grid((160, 120)))
