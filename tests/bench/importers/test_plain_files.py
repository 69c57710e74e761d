"""Folders of pictures, arrays, and the tables that ROS tools export, as a recording."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_recording import texture
from typer.testing import CliRunner

import bench.cli
from bench.importers import registry
from bench.recording.folder import open_recording
from synth.errors import UserError

VIDEO = np.stack([texture(48, 64, seed) for seed in range(12)])


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    folder = tmp_path / "cam"
    folder.mkdir()
    for k, rgb in enumerate(VIDEO):
        cv2.imwrite(str(folder / f"img{k}.png"), rgb[..., ::-1])  # img10 comes after img9
    return folder


def test_a_folder_of_pictures_with_a_ros_table_becomes_a_recording(pictures: Path, tmp_path: Path) -> None:
    table = tmp_path / "ft.csv"
    rows = "\n".join(f"{(17 * 10**8 + k) * 10**9},{k},{0.1 * k},0,-0.5" for k in range(4))
    table.write_text(
        f"%time,field.header.seq,field.wrench.force.x,field.wrench.force.y,field.wrench.force.z\n{rows}\n"
    )
    stamps = tmp_path / "stamps.csv"
    stamps.write_text("\n".join(["t_s", *(f"{1.7e9 + k / 4:.3f}" for k in range(12))]) + "\n")
    out = tmp_path / "rec"
    words = ["import", str(pictures), "-o", str(out), "--scale", "0.1"]
    words += ["--use", f"force={table}", "--use", f"frame_time={stamps}"]
    done = CliRunner().invoke(bench.cli.app, words)
    assert done.exit_code == 0, done.output
    recording = open_recording(out)
    assert recording.force is not None
    assert recording.force.time_s == pytest.approx([0, 1, 2, 3], abs=1e-5)
    assert recording.force.force_mn[3] == pytest.approx([300.0, 0.0, -500.0])
    frames = list(recording.frames())
    assert [frame.time_s for frame in frames] == pytest.approx(np.arange(12) / 4, abs=1e-5)
    for frame, rgb in zip(frames, VIDEO, strict=True):
        assert np.abs(frame.rgb.astype(int) - rgb).max() <= 4


def test_a_fast_sensor_that_is_not_in_seconds_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "video.npy", VIDEO)
    table = tmp_path / "ft.csv"

    def read(seconds: float, of: float) -> registry.Intake:
        rows = [f"{of * k / 1000:.6f},0,0,1" for k in range(int(seconds * 1000))]
        table.write_text("\n".join(["t_s,fx,fy,fz", *rows]) + "\n")
        return registry.read_source(tmp_path / "video.npy", {"fps": "25", "force": str(table)})

    for unit in (1e3, 1e6):
        with pytest.raises(UserError, match="seconds"):
            read(1, unit)
    assert len(read(1, 1).force) == 1000
    # A sensor may run for two minutes next to half a second of video.
    assert len(read(120, 1).force) == 120_000
