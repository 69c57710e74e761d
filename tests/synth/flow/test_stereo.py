"""Stereo: rectification against OpenCV's projections, and known motion in three dimensions."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from synth.errors import UserError
from synth.flow.stereo import depth_correction, depth_motion, rest
from synth.flow.stereo.rig import Intrinsics, Rectified, StereoRig
from synth.flow.stereo.stereo_track import StereoTracker

SIZE = (160, 120)
FOCAL, BASE, AWAY = 1370.0, 24.0, 300.0
K = np.array([[FOCAL, 0, 79.5], [0, FOCAL, 59.5], [0, 0, 1.0]])
K_RIGHT = K + np.array([[0, 0, FOCAL * BASE / AWAY], [0, 0, 0], [0, 0, 0]])
PINHOLES = Intrinsics(K, np.zeros(5)), Intrinsics(K_RIGHT, np.zeros(5))
PARALLEL = StereoRig(*PINHOLES, np.eye(3), np.array([-BASE, 0.0, 0.0]), SIZE)
TURN = cv2.Rodrigues(np.array([0.004, 0.08, 0.01]))[0]
LEFT = Intrinsics(K, np.array([-0.2, 0.1, 0.002, -0.001, 0.0]))
RIGHT = Intrinsics(np.diag([1.01, 1.01, 1.0]) @ K, np.array([-0.1, 0.0, 0.0, 0.001, 0.0]))
TURNED = StereoRig(LEFT, RIGHT, TURN, TURN @ np.array([-BASE, 0.4, -0.8]), SIZE)
COLUMNS, ROWS = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
EVERY, NONE = np.ones(SIZE[::-1], bool), np.zeros(SIZE[::-1], bool)
TRUST = np.ones(SIZE[::-1], np.float32)
INNER = (slice(10, -10), slice(10, -10), 2)


def texture(rng: np.random.Generator) -> np.ndarray:
    """A picture larger than the view, with detail of all sizes."""
    noise = rng.normal(size=(400, 400))
    rough = sum(gaussian_filter(noise, s) * s for s in (1.2, 2.5, 6.0))
    return np.asarray(128 + 30 * rough / rough.std(), np.float32)


def view(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: the picture sampled at x, y."""
    samples = cv2.remap(picture, (x + 120).astype(np.float32), (y + 140).astype(np.float32), cv2.INTER_CUBIC)
    return np.repeat(np.clip(samples, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def source(along: np.ndarray, up: float = 0.0) -> np.ndarray:
    """Rest columns (H, W) that are visible at each pixel after tissue has moved by (along, -up)."""
    x, rows = COLUMNS.astype(np.float64), (ROWS + up).astype(np.float32)
    for _ in range(40):
        x = COLUMNS - cv2.remap(along, x.astype(np.float32), rows, cv2.INTER_LINEAR, borderMode=1)
    return x


def dent(amount: float) -> np.ndarray:
    """Change of disparity (H, W) px of a dent in the middle."""
    return -amount * np.exp(-((COLUMNS - 80) ** 2 + (ROWS - 60) ** 2) / (2 * 18.0**2))


@pytest.mark.parametrize("rig", [PARALLEL, TURNED])
def test_rectified_rows_and_depths_match_opencvs_projections(rig: StereoRig) -> None:
    rng = np.random.default_rng(3)
    points = np.stack([rng.uniform(-8, 8, 50), rng.uniform(-6, 6, 50), rng.uniform(290, 310, 50)], axis=1)
    moved_points = points + rng.normal(scale=1.0, size=points.shape)
    rectified = Rectified(rig)
    turn = cv2.Rodrigues(rig.rotation)[0]

    def rectify(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rectified pixels of points in both pictures, by way of the original pixels."""
        pixels = []
        for camera, pose in enumerate(((np.zeros(3), np.zeros(3)), (turn, rig.translation))):
            lens = (rig.left, rig.right)[camera]
            raw_pixels = cv2.projectPoints(positions, *pose, lens.K, lens.distortion)[0][:, 0]
            inverse = rectified._inverse[camera]
            sampling = *raw_pixels.T.astype(np.float32)[:, None], cv2.INTER_LINEAR
            pixels.append(np.stack([cv2.remap(plane, *sampling)[0] for plane in inverse], axis=1))
        return pixels[0], pixels[1]

    left, right = rectify(points)
    pixel_pairs = np.hstack([left, right])
    inside = ((pixel_pairs > 2) & (pixel_pairs < np.array(SIZE * 2) - 3)).all(axis=1)
    assert inside.sum() > 15
    np.testing.assert_allclose(left[inside, 1], right[inside, 1], atol=0.02)
    disparity = np.float32(left[:, 0] - right[:, 0])
    depth = rectified.depth(disparity)
    rotated_points = points @ rectified._views[0][1].T
    np.testing.assert_allclose(depth[inside], rotated_points[inside, 2], rtol=1e-3)
    after_left, after_right = rectify(moved_points)
    flow, change = after_left - left, (after_left - after_right)[:, 0] - disparity
    for k in np.flatnonzero(inside)[:10]:
        # `motion` takes whole pictures: these have the values of the point everywhere.
        pixel = np.rint(left[k]).astype(int)
        field = np.full(SIZE[::-1], disparity[k], np.float32)
        planes = np.stack([np.full(SIZE[::-1], part, np.float32) for part in flow[k]])
        motion = rectified.motion(field, np.full_like(field, change[k]), planes)[pixel[1], pixel[0]]
        np.testing.assert_allclose(motion, moved_points[k] - points[k], atol=0.03)


def test_rest_disparity_of_a_slope_with_a_step() -> None:
    picture = texture(np.random.default_rng(1))
    truth = 4.3 + 0.03 * (COLUMNS - 80) + 3.0 * (ROWS > 60)
    left = view(picture, COLUMNS, ROWS)[..., 0].astype(np.float32)
    # The right picture shows at x - d what the left one shows at x, solved by fixed-point iteration.
    x = COLUMNS.astype(np.float64)
    for _ in range(30):
        x = COLUMNS + 4.3 + 0.03 * (x - 80) + 3.0 * (ROWS > 60)
    right = view(picture, x, ROWS)[..., 0].astype(np.float32)
    matching = rest.match(left, right, EVERY, EVERY)
    coarse_matching = rest.match(left, right, EVERY, EVERY, refine=False)
    inner = (slice(8, -8), slice(16, -16))
    error, coarse_error = (np.abs(result.disparity - truth)[inner] for result in (matching, coarse_matching))
    assert np.median(error) < 0.05
    assert error.mean() < coarse_error.mean()
    assert (error > 2).mean() < 0.02
    assert matching.epipolar_px < 0.05
    with pytest.raises(UserError):
        rest.match(left, np.zeros_like(left), EVERY, EVERY)


def test_a_dent_and_a_shift_are_found_in_millimetres() -> None:
    rng = np.random.default_rng(5)
    picture = texture(rng)
    d, v = dent(0.6), -0.8
    u = 1.7 - 4.0 * d  # the tissue is strained where it is dented

    def add_noise(rgb: np.ndarray) -> np.ndarray:
        return np.clip(rgb + rng.normal(scale=2.0, size=rgb.shape), 0, 255).astype(np.uint8)

    # The tissue lies at the distance of zero disparity.
    rest_pictures = add_noise(view(picture, COLUMNS, ROWS)), add_noise(view(picture, COLUMNS, ROWS))
    left, right = (add_noise(view(picture, source(along, -v), ROWS - v)) for along in (u, u - d))
    tracker = StereoTracker(PARALLEL, rest_pictures[0][None], rest_pictures[1][None], NONE, NONE, EVERY)
    flow = np.stack([u, np.full_like(u, v)], axis=-1).astype(np.float32)
    step = tracker.step(left, right, NONE, NONE, flow, TRUST)
    depth = FOCAL * BASE / (FOCAL * BASE / AWAY + d)
    error = (step.motion[..., 2] - (depth - AWAY))[INNER[:2]]
    assert (depth - AWAY).max() > 1.5
    assert np.sqrt((error**2).mean()) < 0.12
    assert step.motion[60, 80, 2] == pytest.approx(depth[60, 80] - AWAY, abs=0.2)
    lateral_error = step.motion[60, 80, :2] - np.array([u[60, 80], v]) * AWAY / FOCAL
    assert np.abs(lateral_error).max() < 0.02
    assert (step.deviation[INNER[:2]] > 0).all()


def test_a_blocked_right_camera_raises_the_deviation_and_the_next_frame_recovers() -> None:
    picture = texture(np.random.default_rng(6))
    rest_frame = view(picture, COLUMNS, ROWS)
    tracker = StereoTracker(PARALLEL, rest_frame[None], rest_frame[None], NONE, NONE, EVERY)
    still_flow = np.zeros((*SIZE[::-1], 2), np.float32), TRUST
    clear_step = tracker.step(rest_frame, rest_frame, NONE, NONE, *still_flow)
    blocked_step = tracker.step(rest_frame, np.zeros_like(rest_frame), NONE, EVERY, *still_flow)
    next_step = tracker.step(rest_frame, rest_frame, NONE, NONE, *still_flow)
    assert np.abs(clear_step.motion[INNER]).max() < 0.05
    assert np.abs(blocked_step.motion[INNER]).max() < 0.05
    assert (blocked_step.deviation[INNER] > 3 * clear_step.deviation[INNER]).all()
    np.testing.assert_allclose(next_step.motion, clear_step.motion, atol=1e-3)


def test_a_right_picture_of_another_moment_is_detected() -> None:
    rng = np.random.default_rng(7)
    picture = texture(rng)
    rest_frame = view(picture, COLUMNS, ROWS)
    picture_now, earlier_picture = (
        view(picture, COLUMNS - 1.5 * part, ROWS - 1.2 * part) for part in (1.0, 0.5)
    )
    flow = np.tile(np.array([1.5, 1.2], np.float32), (*SIZE[::-1], 1))
    lags, spreads, errors = [], [], []
    for right in (picture_now, earlier_picture):
        tracker = StereoTracker(PARALLEL, rest_frame[None], rest_frame[None], NONE, NONE, EVERY)
        step = tracker.step(picture_now, right, NONE, NONE, flow, TRUST)
        lags.append(tracker.lag)
        spreads.append(np.median(step.deviation[INNER]))
        errors.append(np.sqrt(np.square(step.motion[INNER]).mean()))
    assert abs(lags[0]) < 0.05
    assert lags[1] == pytest.approx(0.5, abs=0.2)
    assert errors[1] > 10 * errors[0], "half of the motion appears as depth"
    assert spreads[1] > 0.5 * errors[1]


def test_features_hold_the_remaining_step_of_depth_in_millimetres() -> None:
    solver = depth_motion.Solver(SIZE[::-1])
    zeros, ones = np.zeros(SIZE[::-1], np.float32), np.ones(solver.shape, np.float32)
    # A remaining step of 0.1 px is -0.02 mm at 5 px/mm.
    change = depth_motion.Change(zeros, 1e4 * ones, 1e3 * ones, ones, ones, zeros)
    flow = np.stack([zeros, zeros])
    features = depth_correction.describe(change, solver, flow, ones, 0.5 * ones, px_per_mm=5.0, mm_per_px=0.2)
    assert features.shape == (depth_correction.CHANNELS, *solver.shape)
    np.testing.assert_allclose(features[[5, 7]], -0.02, rtol=1e-2)
    np.testing.assert_allclose(np.exp(features[6]), 1 / (100 * 5), rtol=1e-3)
    np.testing.assert_allclose(np.exp(features[11]), 0.1, rtol=1e-5)


def test_the_plate_penalises_bending_but_not_tilting() -> None:
    bends = depth_motion.second_differences((9, 11))
    rows, columns = np.mgrid[:9, :11]
    assert np.abs(bends @ (2.0 + 0.3 * columns - 0.7 * rows).ravel()).max() < 1e-12
    assert np.abs(bends @ (columns**2).ravel()).max() == pytest.approx(2.0)
    assert np.abs(bends @ (columns * rows).ravel()).max() == pytest.approx(np.sqrt(2))
