"""A dataset rendered with the pair of a `stereoCalibrate` file, against OpenCV's projections."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.recording.from_sequence import export_recording
from synth.checks import optics, verify
from synth.dataset.store import open_sequence
from synth.engine.run import open_dataset
from synth.errors import UserError
from synth.flow.stereo.calibration import read_rig
from synth.job.schema import Job, RenderSection
from synth.publish.export import tapvid
from synth.render.camera import camera
from synth.render.mitsuba import lens
from synth.sequence import scenario
from synth.sequence.draw import read_lens
from synth.sequence.pipeline import write_scene
from synth.sequence.simulation import simulate

SIZE = (128, 96)
DISTANCE_MM = 200.0
TURN = cv2.Rodrigues(np.array([0.003, np.radians(3.0), 0.004]))[0]
PAIR = {
    "K1": np.array([[720.0, 0, 66.0], [0, 715.0, 45.0], [0, 0, 1]]),
    "D1": np.array([[-0.9, 4.0, 0.002, -0.003, 2.0, -0.4, 3.0, 1.0]]),
    "K2": np.array([[790.0, 0, 61.0], [0, 795.0, 50.0], [0, 0, 1]]),
    "D2": np.array([[-0.5, 2.0, -0.002, 0.001, 0.5, 0.3, -1.0, 0.5]]),
    "R": TURN,
    # A point on the left axis is on the right one as well.
    "T": np.array([[0.1], [0.2], [DISTANCE_MM]]) - TURN @ np.array([[0.0], [0.0], [DISTANCE_MM]]),
}


def write_calibration(path: Path, **changes: np.ndarray) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, values in (PAIR | changes).items():
        storage.write(name, values)
    storage.release()
    return path


def make_job(path: Path, **render: object) -> Job:
    view = {
        "calibration": path,
        "size": SIZE,
        "working_distance_mm": (DISTANCE_MM, DISTANCE_MM),
        "tilt_deg": (10, 10),
    }
    return Job.model_validate(
        {
            "seed": 4,
            "sequences": 1,
            "frames": 4,
            "anatomy": {"vertices": 2500},
            "fem": {"tets": 400, "gestures": ["push"]},
            "render": view | render,
            "store": {"extra": ["camera"]},
        }
    )


@pytest.mark.slow
def test_labels_of_a_converging_pair_are_where_opencv_projects_them(tmp_path: Path) -> None:
    job = make_job(write_calibration(tmp_path / "pair.yaml"), drift_mm=(0.3, 0.3))
    assert job.render.stereo_mm == pytest.approx(np.linalg.norm(PAIR["T"]))
    with open_dataset(tmp_path / "out", Job.model_validate(job.model_dump())) as folder:
        write_scene(simulate(job), folder)
    sequence = open_sequence(tmp_path / "out/000000.zarr")
    shown_pixels = sequence["tissue"][:] & ~sequence["tool"][0] & sequence["visible_right"][0]
    rows, columns = (indices[::7] for indices in np.nonzero(shown_pixels))
    depth, left_pose = sequence["depth"][0][rows, columns].astype(float), (np.zeros(3), np.zeros(3))
    pixels = np.stack([columns, rows], axis=1).astype(float)
    points = camera.rays(optics.camera_of(sequence), pixels) * depth[:, None]
    right_pose = cv2.Rodrigues(PAIR["R"])[0], PAIR["T"]
    right, left = {}, {}
    for t in range(4):
        moved_points = points + sequence["motion"][t][rows, columns]
        left[t] = cv2.projectPoints(moved_points, *left_pose, PAIR["K1"], PAIR["D1"])[0][:, 0]
        assert t or np.abs(left[0] - pixels).max() < 1e-6  # the rays are OpenCV's
        right[t] = cv2.projectPoints(moved_points, *right_pose, PAIR["K2"], PAIR["D2"])[0][:, 0]
        np.testing.assert_allclose(sequence["flow"][t][rows, columns], left[t] - pixels, atol=0.01)
    x, x_right = (
        cv2.projectPoints(points, *pose, PAIR[K], None)[0][:, 0, 0]
        for pose, K in ((left_pose, "K1"), (right_pose, "K2"))
    )
    np.testing.assert_allclose(sequence["disparity"][:][rows, columns], x - x_right, atol=0.01)
    inside = ((right[0] > 1) & (right[0] < np.array(SIZE) - 2)).all(axis=1)
    assert inside.sum() > 300
    x, y = right[0][inside].astype(np.float32).T
    moved_right = cv2.remap(sequence["flow_right"][3], x[None], y[None], cv2.INTER_LINEAR)[0]
    error = np.abs(moved_right - (right[3] - right[0])[inside]).max(axis=1)
    assert np.median(error) < 0.01  # interpolated between pixels, except at edges
    right_depth = (points @ PAIR["R"].T + PAIR["T"].T)[inside, 2]
    stored_depth = cv2.remap(sequence["depth_right"][0], x[None], y[None], cv2.INTER_LINEAR)[0]
    assert np.median(np.abs(stored_depth - right_depth)) < 0.01

    (check,) = [check for check in verify.verify_dataset(tmp_path / "out").checks if check.name == "stereo"]
    assert check.count > 20
    assert not check.bad, check.failures
    export_recording(sequence, tmp_path / "recording")
    rig = read_rig(tmp_path / "recording/stereo.yaml", SIZE)
    for value, name in ((rig.right.K, "K2"), (rig.right.distortion, "D2"), (rig.rotation, "R")):
        np.testing.assert_allclose(value, PAIR[name].reshape(value.shape), atol=1e-9)
    np.testing.assert_allclose(rig.translation, PAIR["T"].ravel(), atol=1e-9)
    tracks = tapvid._in_depth(sequence, np.stack([columns, rows], axis=1))["tracks_XYZ"]
    np.testing.assert_allclose(1000 * tracks[0], points, atol=0.02)
    recovered = sequence["motion_recovered"][2][rows, columns] - sequence["motion"][2][rows, columns]
    assert np.median(np.abs(recovered)) < 0.1


def test_keys_that_the_calibration_sets_and_pairs_that_show_nothing_are_refused(tmp_path: Path) -> None:
    path = write_calibration(tmp_path / "pair.yaml")
    for name, value in (("field_mm", 30), ("distortion", (0.1, 0, 0, 0, 0)), ("stereo_mm", 5.0)):
        with pytest.raises(ValueError, match=name):
            RenderSection.model_validate({"calibration": path, name: value})
    for change in ({"T": -PAIR["T"]}, {"T": PAIR["T"] / 1000}, {"T": 4 * PAIR["T"]}):
        with pytest.raises(UserError):
            _ = simulate(make_job(write_calibration(tmp_path / "bad.yaml", **change))).renderer


def test_the_compiled_lens_inverts_a_strong_distortion(tmp_path: Path) -> None:
    distortion = np.array([[-0.3, 0.05, 0.0, 0.0, 0.0]])
    K = np.array([[80.0, 0, 63.5], [0, 80.0, 47.5], [0, 0, 1]])
    render = make_job(write_calibration(tmp_path / "pair.yaml", K1=K, D1=distortion)).render
    view = camera.place(scenario.draw_view(render, np.random.default_rng(0)), read_lens(render))
    rounds = lens._count_rounds(view)
    assert rounds > 6
    pixels = camera.pixel_grid(view.size)
    x, y = (pixels - view.K[:2, 2]).T / np.diag(view.K)[:2, None]
    undistorted = np.stack(lens._undistort(x, y, lens._coefficients(view), rounds), axis=1)
    exact = camera.rays(view, pixels)[:, :2]
    assert np.abs(undistorted - exact).max() * 80 < 0.02
