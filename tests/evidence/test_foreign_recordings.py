"""Recordings simulated and rendered by other programs: interpolation, forces, calibration."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bench.recording.recording_folder import open_recording
from evidence import gap
from evidence.foreign import recordings
from learn.data.clips import amount
from learn.data.grid import Grid


def solve_surface() -> dict[str, Any]:
    """A surface that sinks by the square of the level and rises by 0.2 mm with the pulse, as by felupe."""
    x = np.linspace(-45, 45, 9)
    nodes = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    displacement, pulse = np.zeros((4, 3, len(nodes), 3)), np.zeros((len(nodes), 3))
    displacement[..., 2] = -np.square([1 / 3, 2 / 3, 1])[None, :, None]
    pulse[:, 2] = 0.2
    return {"at": nodes, "moved": displacement, "pulse": pulse}


def test_the_surface_interpolates_levels_and_nodes() -> None:
    surface = recordings.Surface.of(solve_surface(), np.random.default_rng(0))
    assert np.abs(surface.at(np.zeros(4), 0.0)).max() == 0
    for level in (0.2, 1 / 3, 0.8, 1.0):
        displacement = surface.at(np.array([0, level, 0, 0]), 0.5)
        assert displacement[..., 2] == pytest.approx(0.1 - level**2, abs=1e-9)
        assert np.abs(displacement[..., :2]).max() < 1e-12


@pytest.mark.trial
@pytest.mark.parametrize("kind", ["pulse", "two"])
def test_a_recording_contains_the_prescribed_force(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With both programs replaced, their input and the recording agree."""
    inputs: dict[str, Any] = {}

    def stub_run(python: Path, folder: Path, work: str, values: dict[str, Any], arrays: Any = None) -> Path:
        inputs[work] = values
        if work == "mechanics":
            np.savez(folder / "mechanics.npz", **solve_surface())
        else:
            picture = cv2.resize(np.uint8(255 * arrays["albedo"]), (320, 240))
            for prefix in values["cameras"]:
                for k in range(len(arrays["moved"])):
                    cv2.imwrite(str(folder / f"{prefix}{k:05d}.png"), picture)
        return folder / f"{work}.npz"

    monkeypatch.setattr(recordings, "run", stub_run)
    part, pythons = tmp_path / "part", (Path("a"), Path("b"))
    part.mkdir()
    recordings.record(part, f"{kind}-0", kind, np.random.default_rng(500), (10.0, 2.0, 1), pythons)
    recording = open_recording(part)
    rows = np.loadtxt(part / "force.csv", delimiter=",", skiprows=1)
    forces = [
        np.sum([tool["force_mn"] for tool in tools], axis=0) for tools in inputs["mechanics"]["contacts"]
    ]
    strongest = max(np.linalg.norm(force) for force in forces)
    size_mn = 1000 * np.linalg.norm(rows[:, 1:], axis=1)
    assert 0.5 * strongest < size_mn.max() < 1.1 * strongest
    assert np.median(size_mn[rows[:, 0] < 1.9]) < 0.1
    # A press points away from the camera: positive along the line of sight.
    peaks = [rows[np.argmax(size_mn * (np.abs(rows[:, 0] - t) < 0.75)), 3] for t in (2.75, 4.25, 5.75, 7.25)]
    assert [bool(peak > 0) for peak in peaks] == [force[2] < 0 for force in forces]
    assert recording.meta.stereo
    assert recording.meta.young_kpa == inputs["mechanics"]["young_kpa"]
    clip = gap.read_foreign_clip(part, Grid(16))
    assert amount(clip, 1, 2.25)[:, 0] * clip.young_kpa == pytest.approx(np.linalg.norm(clip.force, axis=1))
    assert np.abs(clip.displacement["ideal"]).max() > 10 * np.abs(clip.displacement["recovered"]).max() > 0


def test_calibration_and_true_flow_agree_with_opencv(tmp_path: Path) -> None:
    """A point has the same projection by Blender's matrices and by OpenCV with the file's K, R and T."""
    left, focal = recordings.first_camera(np.random.default_rng(4))
    right = recordings.right_camera(left)
    recordings.write_pair(tmp_path / "pair.yaml", left, right, focal)
    file = cv2.FileStorage(str(tmp_path / "pair.yaml"), cv2.FILE_STORAGE_READ)
    K, R, T = (file.getNode(name).mat() for name in ("K2", "R", "T"))
    point = np.array([4.0, -7.0, 1.5])
    x, y, z = right[:3, :3].T @ (point - right[:3, 3])
    in_left = np.diag([1.0, -1.0, -1.0]) @ left[:3, :3].T @ (point - left[:3, 3])
    projection, _ = cv2.projectPoints(in_left[None], cv2.Rodrigues(R)[0], T, K, None)
    expected = np.array([x, -y]) / -z * focal + np.array([159.5, 119.5])
    assert projection.ravel() == pytest.approx(expected, abs=1e-6)
    assert np.linalg.norm(T) == pytest.approx(24.0)
    rest = np.stack([*np.meshgrid(*2 * [np.linspace(-23, 23, 231)]), np.zeros((231, 231))], axis=-1)
    flow = recordings.project_flow(rest, np.broadcast_to([0.4, -0.3, 0.5], rest.shape), left, focal)
    points = np.array([[4.0, -7.0, 0.0], [4.4, -7.3, 0.5]])
    in_left = (points - left[:3, 3]) @ left[:3, :3] * [1, -1, -1]
    start, end = cv2.projectPoints(in_left, np.zeros(3), np.zeros(3), K, None)[0][:, 0]
    column, row = np.rint(start).astype(int)
    assert flow[row, column] == pytest.approx(end - start, abs=0.005)
