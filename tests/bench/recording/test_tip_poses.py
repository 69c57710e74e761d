"""Poses of a tracker as prior of instrument masks: projected by OpenCV, weighed by their odds, refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.recording.footage import as_footage
from bench.recording.meta import Tips
from bench.recording.recording_folder import open_recording
from bench.recording.recording_writer import write_poses
from bench.recording.tip_poses import read_tips
from synth.errors import UserError
from synth.flow.segmentation import Segmentation

K = np.array([[400.0, 0, 79.5], [0, 400, 59.5], [0, 0, 1]])
TURN = cv2.Rodrigues(np.array([0.2, -0.1, 0.5]))[0]
SHIFT = np.array([3.0, -4.0, 200.0])
NAME = "TipToWorldTransform"


def poses_of(count: int = 3) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = 4.0 * np.arange(count)
    poses[:, :3, :3] = cv2.Rodrigues(np.array([0.0, 1.1, 0.0]))[0]
    poses[-1] = np.nan  # a status of INVALID
    return poses


def tips_of(**keys: object) -> Tips:
    projection = K @ np.column_stack([TURN, SHIFT])
    return Tips.model_validate({"projection": projection.tolist(), "radius_mm": 1.0, **keys})


def test_tips_are_where_opencv_projects_them(tmp_path: Path) -> None:
    write_poses(tmp_path, np.arange(3) / 25, {NAME: poses_of()})
    prior = read_tips(tmp_path / "poses.csv", tips_of(), 0.5)
    for k in (0, 1):
        mask = prior.expect(k, (120, 160))
        place = poses_of()[k, :3, 3]
        tip_px = cv2.projectPoints(place[None], cv2.Rodrigues(TURN)[0], SHIFT, K, None)[0].ravel()
        assert mask is not None
        np.testing.assert_allclose(np.argwhere(mask).mean(axis=0)[::-1], tip_px, atol=0.6)
        assert mask.sum() < 30  # of 2 px radius
    assert prior.expect(2, (120, 160)) is None
    assert prior.expect(7, (120, 160)) is None


def test_a_shaft_leads_from_the_tip_to_the_hand(tmp_path: Path) -> None:
    write_poses(tmp_path, np.arange(3) / 25, {NAME: poses_of()})
    mask = read_tips(tmp_path / "poses.csv", tips_of(axis=[0, 0, 1]), 0.5).expect(0, (120, 160))
    pose = poses_of()[0]
    for along in (0.0, 10.0, 20.0):
        place = pose[:3, 3] + along * pose[:3, 2]
        x, y = np.rint(cv2.projectPoints(place[None], cv2.Rodrigues(TURN)[0], SHIFT, K, None)[0].ravel())
        assert mask is not None
        assert 0 <= x < 160
        assert mask[int(y), int(x)]
    x, y = np.rint(cv2.projectPoints((pose[:3, 3] - 8 * pose[:3, 2])[None], cv2.Rodrigues(TURN)[0], SHIFT, K,
                                     None)[0].ravel())  # fmt: skip
    assert not mask[int(y), int(x)]


def test_odds_are_raised_where_an_instrument_is_expected() -> None:
    flat = np.array([[0.05, 0.5, 0.6, 0.95]], np.float32)
    segmentation = Segmentation(flat, 0 * flat, 0 * flat)
    instrument = segmentation.expect(np.array([[True, True, False, True]])).instrument
    np.testing.assert_allclose(
        instrument, [[9 * 0.05 / (0.95 + 9 * 0.05), 0.9, 0.6, 9 * 0.95 / 8.6]], rtol=1e-5
    )
    assert not Segmentation(0 * flat, flat, flat).expect(np.ones((1, 4), bool)).instrument.any()


def test_a_recording_hands_them_to_its_masks(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "frames" / f"{k:06d}.png"), np.full((120, 160, 3), 90, np.uint8))
    rows = "\n".join(f"    - {row}" for row in (K @ np.column_stack([TURN, SHIFT])).tolist())
    about = f"scale_mm_per_px: 0.5\nfps: 25\ntips:\n  projection:\n{rows}\n"
    (tmp_path / "meta.yaml").write_text(about)
    with pytest.raises(UserError):
        as_footage(open_recording(tmp_path), 0.5)  # no poses.csv
    write_poses(tmp_path, np.arange(3) / 25, {NAME: poses_of()})
    expected = as_footage(open_recording(tmp_path), 0.5).expected
    assert expected is not None
    assert expected(0, (120, 160)).any()  # type: ignore[union-attr]
    (tmp_path / "meta.yaml").write_text(about + "  names: [Other]\n")
    with pytest.raises(UserError, match="no pose other"):
        as_footage(open_recording(tmp_path), 0.5)
    (tmp_path / "meta.yaml").write_text(about.replace(rows, "    - [1, 0, 0, 0]\n" * 3))
    with pytest.raises(UserError, match="rank"):
        open_recording(tmp_path)
