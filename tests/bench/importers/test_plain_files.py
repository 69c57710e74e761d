"""Folders of pictures, arrays, and the tables that ROS tools export, as a recording."""

from __future__ import annotations

import os
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

FILM = np.stack([texture(48, 64, seed) for seed in range(12)])


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    folder = tmp_path / "cam"
    folder.mkdir()
    for k, rgb in enumerate(FILM):
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
    for frame, rgb in zip(frames, FILM, strict=True):
        assert np.abs(frame.rgb.astype(int) - rgb).max() <= 4


def test_an_array_with_a_rate(tmp_path: Path) -> None:
    np.save(tmp_path / "film.npy", FILM)
    found = registry.read_source(tmp_path / "film.npy", {"fps": "20"})
    assert found.times_s == pytest.approx(np.arange(12) / 20)
    assert (np.stack(list(found.pictures())) == FILM).all()


@pytest.mark.parametrize(
    ("header", "row", "seconds"),
    [
        (
            "header.stamp.sec,header.stamp.nanosec,wrench.force.x,wrench.force.y,wrench.force.z",
            "7,500000000,1,2,3",
            7.5,
        ),
        ("time,fx,fy,fz", "7.5,1,2,3", 7.5),
    ],
)
def test_stamps_as_tools_write_them(tmp_path: Path, header: str, row: str, seconds: float) -> None:
    from bench.importers import plain_files

    (tmp_path / "t.csv").write_text(f"{header}\n{row}\n")
    time, force = plain_files.read_forces(tmp_path / "t.csv")
    assert time == pytest.approx([seconds])
    assert force.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(("rate_hz", "unit", "word"), [(1000, 1e3, "milli"), (1000, 1e6, "micro")])
def test_a_fast_sensors_other_unit_is_told_by_the_video(
    tmp_path: Path, rate_hz: float, unit: float, word: str
) -> None:
    np.save(tmp_path / "film.npy", FILM)
    table = tmp_path / "ft.csv"

    def read(seconds: float, of: float) -> registry.Intake:
        rows = [f"{of * k / rate_hz:.6f},0,0,1" for k in range(int(seconds * rate_hz))]
        table.write_text("\n".join(["t_s,fx,fy,fz", *rows]) + "\n")
        return registry.read_source(tmp_path / "film.npy", {"fps": "25", "force": str(table)})

    with pytest.raises(UserError, match=f"they look like {word}seconds, not seconds|their times look like"):
        read(1, unit)
    assert len(read(1, 1).force) == 1000
    # Seconds of a sensor that ran for two minutes beside half a second of video.
    assert len(read(120, 1).force) == 120_000


def test_pictures_are_named_as_they_please(pictures: Path) -> None:
    (pictures / "img3.png").rename(pictures / "img3².png")
    assert len(registry.read_source(pictures, {"fps": "5"}).times_s) == 12


def test_a_table_that_is_a_pipe_is_refused(pictures: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for use in ({"frame_time": str(tmp_path / "pipe")}, {"fps": "5", "force": str(tmp_path / "pipe")}):
        with pytest.raises(UserError, match="no regular file"):
            registry.read_source(pictures, use)


def test_what_lacks_is_said(pictures: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="pictures without times"):
        registry.read_source(pictures)
    (tmp_path / "t.csv").write_text("t_s\n1\n")
    with pytest.raises(UserError, match="1 times for 12 pictures"):
        registry.read_source(pictures, {"frame_time": str(tmp_path / "t.csv")})
    with pytest.raises(UserError, match="no columns of force"):
        registry.read_source(pictures, {"fps": "5", "force": str(tmp_path / "t.csv")})
    np.save(tmp_path / "flat.npy", np.zeros(3))
    with pytest.raises(UserError, match="expected"):
        registry.read_source(tmp_path / "flat.npy", {"fps": "5"})
