"""A microscope that moves, and its second lens."""

from dataclasses import replace

import cv2
import numpy as np

from synth.job.schema import RenderSection
from synth.render.camera import camera
from synth.sequence import scenario

RENDER = RenderSection(tilt_deg=(15.0, 15.0), drift_mm=(0.4, 0.4))
LENS = camera.place(scenario.draw_view(RENDER, np.random.default_rng(1)), RENDER)


def test_drift_starts_at_rest_and_is_as_large_as_asked_for() -> None:
    sway = scenario.draw_camera_motion(RENDER, np.random.default_rng(5))
    x = [sway.at(LENS, t).translation for t in np.arange(0, 2000, 0.5)]
    np.testing.assert_array_equal(x[0], LENS.translation)
    np.testing.assert_allclose(np.std(x, axis=0), 0.4 / np.sqrt(2), rtol=0.15)


def test_the_second_lens_sees_the_disparity_of_a_rectified_pair() -> None:
    right = camera.right_camera(LENS, 20.0)
    points = np.random.default_rng(0).uniform(-8, 8, (30, 3))
    plain = replace(LENS, distortion=np.zeros(5)), replace(right, distortion=np.zeros(5))
    left_px, right_px = (camera.project(lens, points) for lens in plain)
    depth = camera.to_camera(LENS, points)[:, 2]
    disparity = left_px[:, 0] - right_px[:, 0]
    distance = LENS.translation[2]
    np.testing.assert_allclose(disparity, LENS.K[0, 0] * 20.0 * (1 / depth - 1 / distance), atol=1e-8)
    np.testing.assert_allclose(left_px[:, 1], right_px[:, 1], atol=1e-9)
    turn, _ = cv2.Rodrigues(right.rotation)
    expected, _ = cv2.projectPoints(points, turn, right.translation, right.K, right.distortion)
    np.testing.assert_allclose(camera.project(right, points), expected[:, 0], atol=1e-6)


def test_blur_is_the_spread_of_rays_through_the_lens() -> None:
    depth = np.array([0.0, LENS.focus_mm, LENS.focus_mm + 3.0])
    radius = camera.blur_radius(LENS, depth)
    assert radius[0] == 0
    assert radius[1] < 1e-6
    # A ray from the lens's edge through the point in focus, met again 3 mm behind it.
    focus = LENS.focus_mm
    miss = LENS.aperture_mm * 3.0 / focus
    assert np.isclose(radius[2], LENS.K[0, 0] * miss / (focus + 3.0))
