"""Calibrations that OpenCV wrote, and files that are none."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from synth.errors import UserError
from synth.job.schema import RenderSection
from synth.render.camera import calibration, camera
from synth.sequence import scenario

K = np.array([[5200.0, 0.0, 331.5], [0.0, 5180.0, 244.25], [0.0, 0.0, 1.0]])
LENS = np.array([[-0.21, 0.08, 0.001, -0.002, 0.03]])


def written(path: Path, lens: np.ndarray = LENS) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", lens)
    storage.release()
    return path


@pytest.mark.parametrize("name", ["c.yaml", "c.xml", "c.json"])
def test_what_opencv_wrote_is_read(tmp_path: Path, name: str) -> None:
    matrix, distortion = calibration.read(written(tmp_path / name), (640, 480))
    np.testing.assert_allclose(matrix, K)
    np.testing.assert_allclose(distortion, LENS[0])


def test_the_camera_projects_as_opencv_does(tmp_path: Path) -> None:
    render = RenderSection(calibration=written(tmp_path / "c.yaml"), tilt_deg=(12.0, 12.0))
    lens = camera.place(scenario.draw_view(render, np.random.default_rng(3)), render)
    points = np.random.default_rng(0).uniform(-10, 10, (50, 3))
    turn, _ = cv2.Rodrigues(lens.rotation)
    expected, _ = cv2.projectPoints(points, turn, lens.translation, K, LENS)
    np.testing.assert_allclose(camera.project(lens, points), expected[:, 0], atol=1e-6)


def test_another_size_of_the_same_shape_keeps_the_field(tmp_path: Path) -> None:
    found, _ = calibration.read(written(tmp_path / "c.yaml"), (320, 240))
    # The corner of the picture, half a pixel outside the first centre, is where it was.
    assert (-0.5 - found[0, 2]) / found[0, 0] == pytest.approx((-0.5 - K[0, 2]) / K[0, 0])
    with pytest.raises(UserError):
        calibration.read(tmp_path / "c.yaml", (640, 360))


@pytest.mark.parametrize(
    "text",
    [
        "{",
        '{"camera_matrix": [["a", 0, 1], [0, 1, 1], [0, 0, 1]], "dist_coeffs": [0, 0, 0, 0]}',
        '{"camera_matrix": [[9, 0, 1], [0, 9, 1], [0, 0, 1]], "dist_coeffs": [0, 0, 0, 0, 0, 1]}',
    ],
)
def test_a_bad_file_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(UserError):
        calibration.read(tmp_path / "c.json", (640, 480))
