"""Files without a container: folders of pictures, .npy arrays, CSV tables as ROS tools write them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from bench.importers.registry import Intake, picture_files
from bench.recording import csv_table
from synth.arrays import Floats, Pixels
from synth.errors import UserError
from synth.video import read as video

_SECONDS = ("t_s", "time", "timestamp", "t", "time_s", "%time", "__time")
_FORCES = (
    ("fx_n", "fy_n", "fz_n"),
    ("fx", "fy", "fz"),
    ("wrench.force.x", "wrench.force.y", "wrench.force.z"),
    ("field.wrench.force.x", "field.wrench.force.y", "field.wrench.force.z"),
    ("force.x", "force.y", "force.z"),
)
_STAMP = ("header.stamp.sec", "header.stamp.nanosec")
_Pictures = Callable[[], Iterator[Pixels]]
_NANOSECONDS = 1e15  # larger numbers are no seconds of any clock: `rostopic echo -p` writes nanoseconds


def read_source(source: Path, use: dict[str, str]) -> Intake:
    """Opens a folder of pictures, in the order of their numbers, or an .npy of (T, H, W[, C]).

    Times come from `--use frame_time=TABLE.csv`, or from `--use fps=RATE`. Forces come from
    `--use force=TABLE.csv`, in the columns that ROS tools write or t_s, fx_n, fy_n, fz_n.

    Raises:
        UserError: no times, a table without the columns, or not as many times as pictures.
    """
    pictures, count = _array(source) if source.is_file() else _folder(source)
    times = _times(source, use, count)
    return Intake(times, pictures, *(_read_forces(Path(use["force"])) if "force" in use else ()))


def _read_forces(path: Path) -> tuple[Floats, Floats]:
    """Times (N,) s and forces (N, 3) in the table's unit. UserError if the columns are missing."""
    header = csv_table.read_header(path)
    names = next((names for names in _FORCES if set(names) <= set(header)), None)
    if names is None:
        raise UserError(f"{path}: no columns of force; the header has {', '.join(header)}")
    return _seconds(path, header), np.column_stack(list(csv_table.read_csv(path, names).values()))


def _seconds(path: Path, header: list[str]) -> Floats:
    """Times of a table's rows, (N,) s."""
    if set(_STAMP) <= set(header):
        stamp = csv_table.read_csv(path, _STAMP)
        return np.asarray(stamp[_STAMP[0]] + 1e-9 * stamp[_STAMP[1]], np.float64)
    name = next((name for name in _SECONDS if name in header), None)
    if name is None:
        raise UserError(f"{path}: no column of times; the header has {', '.join(header)}")
    time = csv_table.read_csv(path, (name,))[name]
    return np.asarray(1e-9 * time if np.nanmax(time) > _NANOSECONDS else time, np.float64)


def _times(source: Path, use: dict[str, str], count: int) -> Floats:
    if "frame_time" in use:
        path = Path(use["frame_time"])
        times = _seconds(path, csv_table.read_header(path))
        if len(times) != count:
            raise UserError(f"{path}: {len(times)} times for {count} pictures of {source}")
        return times
    rate = float(use.get("fps", "nan"))
    if not (np.isfinite(rate) and rate > 0):
        raise UserError(f"{source}: pictures without times; add --use frame_time=TABLE.csv or --use fps=RATE")
    return np.arange(count) / rate


def _folder(folder: Path) -> tuple[_Pictures, int]:
    paths = tuple(picture_files(folder))
    return lambda: (picture.rgb for picture in video.read_pictures(dict(enumerate(paths)))), len(paths)


def _array(path: Path) -> tuple[_Pictures, int]:
    frames = np.load(path, mmap_mode="r", allow_pickle=False)
    if frames.ndim not in (3, 4):
        raise UserError(f"{path}: an array of shape {frames.shape}, expected (T, H, W) or (T, H, W, C)")
    return lambda: (np.asarray(picture) for picture in frames), len(frames)
