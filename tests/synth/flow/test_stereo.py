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
    found = cv2.remap(picture, (x + 120).astype(np.float32), (y + 140).astype(np.float32), cv2.INTER_CUBIC)
    return np.repeat(np.clip(found, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


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
    moved = points + rng.normal(scale=1.0, size=points.shape)
    rectified = Rectified(rig)
    turn = cv2.Rodrigues(rig.rotation)[0]

    def straight(where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rectified pixels of points in both pictures, by way of the original pixels."""
        found = []
        for camera, pose in enumerate(((np.zeros(3), np.zeros(3)), (turn, rig.translation))):
            lens = (rig.left, rig.right)[camera]
            own = cv2.projectPoints(where, *pose, lens.K, lens.distortion)[0][:, 0]
            inverse = rectified._inverse[camera]
            at = *own.T.astype(np.float32)[:, None], cv2.INTER_LINEAR
            found.append(np.stack([cv2.remap(part, *at)[0] for part in inverse], axis=1))
        return found[0], found[1]

    left, right = straight(points)
    both = np.hstack([left, right])
    inside = ((both > 2) & (both < np.array(SIZE * 2) - 3)).all(axis=1)
    assert inside.sum() > 15
    np.testing.assert_allclose(left[inside, 1], right[inside, 1], atol=0.02)
    disparity = np.float32(left[:, 0] - right[:, 0])
    depth = rectified.depth(disparity)
    turned = points @ rectified._views[0][1].T
    np.testing.assert_allclose(depth[inside], turned[inside, 2], rtol=1e-3)
    after_left, after_right = straight(moved)
    flow, change = after_left - left, (after_left - after_right)[:, 0] - disparity
    for k in np.flatnonzero(inside)[:10]:
        # `motion` takes whole pictures: these have the values of the point everywhere.
        at = np.rint(left[k]).astype(int)
        field = np.full(SIZE[::-1], disparity[k], np.float32)
        planes = np.stack([np.full(SIZE[::-1], part, np.float32) for part in flow[k]])
        found = rectified.motion(field, np.full_like(field, change[k]), planes)[at[1], at[0]]
        np.testing.assert_allclose(found, moved[k] - points[k], atol=0.03)


def test_rest_disparity_of_a_slope_with_a_step() -> None:
    picture = texture(np.random.default_rng(1))
    truth = 4.3 + 0.03 * (COLUMNS - 80) + 3.0 * (ROWS > 60)
    left = view(picture, COLUMNS, ROWS)[..., 0].astype(np.float32)
    # The right picture shows at x - d what the left one shows at x, solved by fixed-point iteration.
    x = COLUMNS.astype(np.float64)
    for _ in range(30):
        x = COLUMNS + 4.3 + 0.03 * (x - 80) + 3.0 * (ROWS > 60)
    right = view(picture, x, ROWS)[..., 0].astype(np.float32)
    found = rest.match(left, right, EVERY, EVERY)
    coarse = rest.match(left, right, EVERY, EVERY, refine=False)
    inner = (slice(8, -8), slice(16, -16))
    error, before = (np.abs(one.disparity - truth)[inner] for one in (found, coarse))
    assert np.median(error) < 0.05
    assert error.mean() < before.mean()
    assert (error > 2).mean() < 0.02
    assert found.epipolar_px < 0.05
    with pytest.raises(UserError):
        rest.match(left, np.zeros_like(left), EVERY, EVERY)


def test_a_dent_and_a_shift_are_found_in_millimetres() -> None:
    rng = np.random.default_rng(5)
    picture = texture(rng)
    d, v = dent(0.6), -0.8
    u = 1.7 - 4.0 * d  # the tissue is strained where it is dented

    def noisy(rgb: np.ndarray) -> np.ndarray:
        return np.clip(rgb + rng.normal(scale=2.0, size=rgb.shape), 0, 255).astype(np.uint8)

    # The tissue lies at the distance of zero disparity.
    first = noisy(view(picture, COLUMNS, ROWS)), noisy(view(picture, COLUMNS, ROWS))
    left, right = (noisy(view(picture, source(along, -v), ROWS - v)) for along in (u, u - d))
    tracker = StereoTracker(PARALLEL, first[0][None], first[1][None], NONE, NONE, EVERY)
    flow = np.stack([u, np.full_like(u, v)], axis=-1).astype(np.float32)
    moved = tracker.step(left, right, NONE, NONE, flow, TRUST)
    depth = FOCAL * BASE / (FOCAL * BASE / AWAY + d)
    error = (moved.motion[..., 2] - (depth - AWAY))[INNER[:2]]
    assert (depth - AWAY).max() > 1.5
    assert np.sqrt((error**2).mean()) < 0.12
    assert moved.motion[60, 80, 2] == pytest.approx(depth[60, 80] - AWAY, abs=0.2)
    across = moved.motion[60, 80, :2] - np.array([u[60, 80], v]) * AWAY / FOCAL
    assert np.abs(across).max() < 0.02
    assert (moved.deviation[INNER[:2]] > 0).all()


def test_a_blocked_right_camera_raises_the_deviation_and_the_next_frame_recovers() -> None:
    picture = texture(np.random.default_rng(6))
    rest_frame = view(picture, COLUMNS, ROWS)
    tracker = StereoTracker(PARALLEL, rest_frame[None], rest_frame[None], NONE, NONE, EVERY)
    still = np.zeros((*SIZE[::-1], 2), np.float32), TRUST
    sure = tracker.step(rest_frame, rest_frame, NONE, NONE, *still)
    blind = tracker.step(rest_frame, np.zeros_like(rest_frame), NONE, EVERY, *still)
    again = tracker.step(rest_frame, rest_frame, NONE, NONE, *still)
    assert np.abs(sure.motion[INNER]).max() < 0.05
    assert np.abs(blind.motion[INNER]).max() < 0.05
    assert (blind.deviation[INNER] > 3 * sure.deviation[INNER]).all()
    np.testing.assert_allclose(again.motion, sure.motion, atol=1e-3)


def test_a_right_picture_of_another_moment_is_detected() -> None:
    rng = np.random.default_rng(7)
    picture = texture(rng)
    rest_frame = view(picture, COLUMNS, ROWS)
    now, before = (view(picture, COLUMNS - 1.5 * part, ROWS - 1.2 * part) for part in (1.0, 0.5))
    flow = np.tile(np.array([1.5, 1.2], np.float32), (*SIZE[::-1], 1))
    lags, spreads, errors = [], [], []
    for right in (now, before):
        tracker = StereoTracker(PARALLEL, rest_frame[None], rest_frame[None], NONE, NONE, EVERY)
        moved = tracker.step(now, right, NONE, NONE, flow, TRUST)
        lags.append(tracker.lag)
        spreads.append(np.median(moved.deviation[INNER]))
        errors.append(np.sqrt(np.square(moved.motion[INNER]).mean()))
    assert abs(lags[0]) < 0.05
    assert lags[1] == pytest.approx(0.5, abs=0.2)
    assert errors[1] > 10 * errors[0], "half of the motion appears as depth"
    assert spreads[1] > 0.5 * errors[1]


def test_features_hold_the_remaining_step_of_depth_in_millimetres() -> None:
    solver = depth_motion.Solver(SIZE[::-1])
    nothing, one = np.zeros(SIZE[::-1], np.float32), np.ones(solver.shape, np.float32)
    # A remaining step of 0.1 px is -0.02 mm at 5 px/mm.
    change = depth_motion.Change(nothing, 1e4 * one, 1e3 * one, one, one, nothing)
    flow = np.stack([nothing, nothing])
    features = depth_correction.describe(change, solver, flow, one, 0.5 * one, px_per_mm=5.0, mm_per_px=0.2)
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
