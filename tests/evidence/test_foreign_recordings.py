"""Recordings of other programs' making: what is ours of them says the truth."""

from __future__ import annotations

import ast
import csv
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bench.recording.folder import open_recording
from evidence.foreign import recordings
from evidence.foreign.recordings import Surface, course
from learn.inference.video import read_video
from synth.errors import UserError

FOLDER = Path(recordings.__file__).parent


@pytest.mark.parametrize("worker", ["felupe_worker.py", "cycles_worker.py"])
def test_a_worker_knows_nothing_of_ours(worker: str) -> None:
    tree = ast.parse((FOLDER / worker).read_text("utf-8"))
    named = [one.module for one in ast.walk(tree) if isinstance(one, ast.ImportFrom)]
    named += [alias.name for one in ast.walk(tree) if isinstance(one, ast.Import) for alias in one.names]
    assert not {"synth", "learn", "bench", "evidence"} & {str(name).split(".")[0] for name in named}


def solved(contacts: int = 4, side: int = 9, levels: int = 3) -> dict[str, Any]:
    """A surface that moves down by the square of the level, and rises with the pulse by 0.2 mm everywhere."""
    x = np.linspace(-45, 45, side)
    at = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    shares = np.linspace(0, 1, levels + 1)[1:]
    moved = np.zeros((contacts, levels, len(at), 3))
    moved[..., 2] = -np.square(shares)[None, :, None]
    pulse = np.zeros((len(at), 3))
    pulse[:, 2] = 0.2
    return {"at": at, "moved": moved, "pulse": pulse}


def test_between_levels_and_nodes_the_surface_moves_as_it_did_at_them() -> None:
    surface = Surface.of(solved(), np.random.default_rng(0))
    assert np.abs(surface.at(np.zeros(4), 0.0)).max() == 0
    for level in (0.2, 1 / 3, 0.8, 1.0):
        found = surface.at(np.array([0, level, 0, 0]), 0.5)
        assert found[..., 2] == pytest.approx(0.1 - level**2, abs=1e-9)
        assert np.abs(found[..., :2]).max() < 1e-12


def test_contacts_come_one_after_the_other_and_both_ends_are_still() -> None:
    hand = course(14.0, np.random.default_rng(2))
    assert ((hand.level > 0).sum(axis=1) <= 1).all()
    assert (hand.level.max(axis=0) > 0.5).all()
    still = (hand.time_s < 1.9) | (hand.time_s > 12.1)
    assert hand.level[still].max() == 0
    # Where a tip presses, it is on the tissue.
    assert hand.away[hand.level > 0.01].max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "pulse"])
def test_a_recording_says_the_force_that_was_put_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Both programs replaced: what they are told and what the folder holds must agree."""
    asked: dict[str, dict[str, Any]] = {}

    def ran(
        python: Path, worker: str, folder: Path, name: str, told: dict[str, Any], given: Any = None
    ) -> Path:
        asked[name] = told
        if name == "mechanics":
            np.savez(folder / "mechanics.npz", **solved())
        else:
            rgb = np.uint8(255 * given["albedo"][::5, ::4][:240, :300])
            shown = np.pad(rgb, ((0, 0), (0, 20), (0, 0)), mode="edge")
            for eye in told["cameras"]:
                for k in range(len(given["moved"])):
                    cv2.imwrite(str(folder / f"{eye}{k:05d}.png"), shown)
        return folder / f"{name}.npz"

    monkeypatch.setattr(recordings, "_run", ran)
    recordings.foreign(tmp_path, Path("a"), Path("b"), kind, 1, 10.0, 2.0, 1, 500, 1 + (kind == "pulse"))
    opened = open_recording(tmp_path / f"{kind}-0")
    assert len(list(read_video(tmp_path / f"{kind}-0" / "video.mp4"))) == 20
    with (tmp_path / f"{kind}-0" / "force.csv").open() as file:
        rows = np.array([[float(v) for v in row] for row in list(csv.reader(file))[1:]])
    strongest = max(np.linalg.norm(one["force_mn"]) for one in asked["mechanics"]["contacts"])
    seen = 1000 * np.linalg.norm(rows[:, 1:], axis=1)
    assert 0.5 * strongest < seen.max() < 1.1 * strongest
    assert np.median(seen[rows[:, 0] < 1.9]) < 0.1
    # A press goes down, away from a camera above: along the line of sight it is positive.
    down = [one["force_mn"][2] < 0 for one in asked["mechanics"]["contacts"]]
    peaks = [rows[np.argmax(seen * (np.abs(rows[:, 0] - t) < 0.75)), 3] for t in (2.75, 4.25, 5.75, 7.25)]
    assert [bool(peak > 0) for peak in peaks] == down
    assert (asked["mechanics"]["pulse_mm"] > 0) == (kind == "pulse")
    assert opened.meta.specimen == f"{kind}-0"
    assert (opened.meta.stereo is not None) == (kind == "pulse")
    assert opened.meta.young_kpa == pytest.approx(asked["mechanics"]["young_kpa"])


def test_the_pair_that_is_written_sees_a_point_where_both_cameras_do(tmp_path: Path) -> None:
    """Projected by Blender's matrices by hand, and by OpenCV with the file's K, R and T."""
    left, focal = recordings._camera(np.random.default_rng(4))
    right = recordings.beside(left)
    recordings.write_pair(tmp_path / "pair.yaml", left, right, focal, (320, 240))
    file = cv2.FileStorage(str(tmp_path / "pair.yaml"), cv2.FILE_STORAGE_READ)
    K, R, T = (file.getNode(name).mat() for name in ("K2", "R", "T"))
    point = np.array([4.0, -7.0, 1.5])

    def seen(camera: np.ndarray) -> np.ndarray:
        x, y, z = camera[:3, :3].T @ (point - camera[:3, 3])
        return np.array([x, -y]) / -z * focal + np.array([159.5, 119.5])

    in_left = np.diag([1.0, -1.0, -1.0]) @ left[:3, :3].T @ (point - left[:3, 3])
    found, _ = cv2.projectPoints(in_left[None], cv2.Rodrigues(R)[0], T, K, None)
    assert found.ravel() == pytest.approx(seen(right), abs=1e-6)
    # Both look at the middle, from 24 mm apart.
    assert np.linalg.norm(T) == pytest.approx(24.0)
    point[:] = 0
    assert seen(left) == pytest.approx(seen(right), abs=1e-9)


def test_a_program_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failed(words: list[Any], **more: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(words, 1, "", "Traceback\nModuleNotFoundError: no felupe\n")

    monkeypatch.setattr(subprocess, "run", failed)
    with pytest.raises(UserError, match=r"felupe_worker\.py: ModuleNotFoundError: no felupe"):
        recordings._run(Path("python"), "felupe_worker.py", tmp_path, "mechanics", {})
    with pytest.raises(UserError, match="there are plain, membrane, pulse"):
        recordings.foreign(tmp_path, Path("a"), Path("b"), "wet", 1, 10.0, 2.0, 1, 500)
