"""The camera model against OpenCV and against itself; its drift, right camera and blur."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from synth.errors import UserError
from synth.job.schema import RenderSection
from synth.render.camera import camera
from synth.sequence import scenario
from synth.sequence.draw import read_lens

STRONG = (-0.3, 0.2, 0.01, -0.02, 0.1)
RENDER = RenderSection(tilt_deg=(15.0, 15.0), drift_mm=(0.4, 0.4))
LENS = camera.place(scenario.draw_view(RENDER, np.random.default_rng(1)), read_lens(RENDER))


def place_distorted(distortion: tuple[float, ...]) -> camera.Camera:
    render = RenderSection(size=(160, 120), distortion=distortion, field_mm=(150.0, 150.0))
    return camera.place(scenario.draw_view(render, np.random.default_rng(3)), read_lens(render))


def assert_projects_as_opencv(lens: camera.Camera, points: np.ndarray) -> None:
    rotation, _ = cv2.Rodrigues(lens.rotation)
    expected, _ = cv2.projectPoints(points, rotation, lens.translation, lens.K, lens.distortion)
    np.testing.assert_allclose(camera.project(lens, points), expected[:, 0], atol=1e-9)


def test_projection_is_opencvs() -> None:
    assert_projects_as_opencv(place_distorted(STRONG), np.random.default_rng(0).uniform(-40, 40, (500, 3)))


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.05, 0.01, 0.0, 0.0, 0.0), STRONG])
def test_a_ray_comes_back_to_its_pixel(distortion: tuple[float, ...]) -> None:
    lens = place_distorted(distortion)
    pixels = camera.pixel_grid(lens.size)
    points = lens.centre + 280 * camera.rays(lens, pixels) @ lens.rotation
    np.testing.assert_allclose(camera.project(lens, points), pixels, atol=1e-8)


def test_it_looks_at_the_craniotomy_from_its_distance_and_tilt() -> None:
    render = RenderSection(tilt_deg=(15.0, 15.0), working_distance_mm=(300.0, 300.0), field_mm=(35.0, 35.0))
    lens = camera.place(scenario.draw_view(render, np.random.default_rng(1)), read_lens(render))
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
        camera.rays(place_distorted((-9.0, 0.0, 0.0, 0.0, 0.0)), camera.pixel_grid((160, 120)))


def test_drift_starts_at_rest_and_has_the_given_size() -> None:
    drift = scenario.draw_camera_motion(RENDER, np.random.default_rng(5))
    x = [drift.at(LENS, t).translation for t in np.arange(0, 2000, 0.5)]
    np.testing.assert_array_equal(x[0], LENS.translation)
    np.testing.assert_allclose(np.std(x, axis=0), 0.4 / np.sqrt(2), rtol=0.15)


def test_the_right_camera_has_the_disparity_of_a_rectified_pair() -> None:
    right = camera.right_camera(LENS, 20.0)
    points = np.random.default_rng(0).uniform(-8, 8, (30, 3))
    cameras = replace(LENS, distortion=np.zeros(5)), replace(right, distortion=np.zeros(5))
    left_px, right_px = (camera.project(lens, points) for lens in cameras)
    depth = camera.to_camera(LENS, points)[:, 2]
    disparity = left_px[:, 0] - right_px[:, 0]
    distance = LENS.translation[2]
    np.testing.assert_allclose(disparity, LENS.K[0, 0] * 20.0 * (1 / depth - 1 / distance), atol=1e-8)
    np.testing.assert_allclose(left_px[:, 1], right_px[:, 1], atol=1e-9)
    assert_projects_as_opencv(right, points)


def test_blur_is_the_spread_of_rays_through_the_lens() -> None:
    depth = np.array([0.0, LENS.focus_mm, LENS.focus_mm + 3.0])
    radius = camera.blur_radius(LENS, depth)
    assert radius[0] == 0
    assert radius[1] < 1e-6
    # A ray from the lens's edge through the point in focus, met again 3 mm behind it.
    focus = LENS.focus_mm
    offset_mm = LENS.aperture_mm * 3.0 / focus
    assert np.isclose(radius[2], LENS.K[0, 0] * offset_mm / (focus + 3.0))
