"""Videos, folders of pictures, TIFF stacks, .npy arrays, and CSV tables next to them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from bench.importers import dicom, igsio
from bench.importers.importer_registry import Intake, SecondView
from bench.recording import sensor_table
from bench.recording.recording_folder import LATE_START_S
from bench.recording.sensor_table import SINCE_1970_S, Readings
from synth.arrays import Array, Floats
from synth.errors import UserError
from synth.system import checked_file
from synth.video import file_numbers
from synth.video import read_video as video
from synth.video.read_video import VideoFile

_GAP_S = 1.5  # between chapters, from which it is one: dates are in whole seconds
_AT_ONCE = 16  # pages of a stack
_Pictures = Callable[[], Iterator[Array]]


def read_source(source: Path, use: dict[str, str]) -> Intake:
    """Opens a video, a folder of pictures or stacks of them, a stack, or an .npy of (T, H, W[, C]).

    Times come from `--use frame_time=TABLE.csv`, from `--use fps=RATE` and the numbers in the names, or from
    the video; forces from `--use force=TABLE.csv`, in the columns that ROS tools write or t_s, fx_n, fy_n,
    fz_n. `--use frames=GLOB` and `right=GLOB` choose among a folder's pictures. UserError for no times, a
    table without the columns, or not as many times as pictures.
    """
    notes: list[str] = []
    pictures, numbers, times = _open(source, use.get("frames"), use, notes)
    if "frame_time" in use:
        times = _frame_seconds(Path(use["frame_time"]), numbers, notes)
    elif "fps" in use:
        rate = float(use["fps"]) if use["fps"].replace(".", "", 1).isdigit() else 0.0
        if rate == 0:
            raise UserError(f"--use fps={use['fps']}: give pictures per second")
        stills = pictures.stills() if isinstance(pictures, _Stills) else {}
        by_name = file_numbers.still_times(stills, rate, notes)
        times = np.array([by_name.get(number, (number - numbers[0]) / rate) for number in numbers])
        if numbers[-1] - numbers[0] != len(numbers) - 1:
            span = f"{numbers[0]} to {numbers[-1]}"
            notes.append(f"{source}: {len(numbers)} numbers from {span}: times follow them")
    if times is None or not np.isfinite(times).all():
        raise UserError(f"{source}: pictures without times; add --use frame_time=TABLE.csv or --use fps=RATE")
    second = None
    if "right" in use:
        right_path = Path(use["right"])
        right_source, pattern = (right_path, None) if right_path.exists() else (source, use["right"])
        right, right_numbers, _ = _open(right_source, pattern, use, notes)
        positions = {number: k for k, number in enumerate(numbers)}
        matches = file_numbers.match_numbers(right_numbers, numbers, "right", notes)
        second = SecondView(
            "right", np.array([positions.get(matches[number], -1) for number in right_numbers]), right
        )
        if (second.frame < 0).all():
            raise UserError(
                f"--use right={use['right']}: no picture has the number of one of the left camera"
            )
    intake = Intake(times, pictures, notes=tuple(notes), second=second)
    if "force" not in use:
        return intake
    table = _read_forces(Path(use["force"]), use.get("columns", ""), times[0] > SINCE_1970_S, notes)
    return replace(
        intake,
        force_s=table.time_s,
        force=table.force,
        axes=table.axes,
        in_newtons=table.in_newtons,
        notes=(*notes, *table.notes),
    )


def _open(
    source: Path, names: str | None, use: Mapping[str, str], notes: list[str]
) -> tuple[_Pictures, list[int], Floats | None]:
    """Pictures, their numbers, and their times [s] if the source has them, NaN where it lacks one."""
    if names and not source.is_dir():
        raise UserError(f"{names}: no such file, and {source} is no folder to choose from")
    if source.is_dir() and (films := films_in(source, names)):
        return _open_chapters(films, use, notes)
    if source.suffix.lower() in video.SUFFIXES:
        film = _choose_film(source, use)
        times, damaged = [], 0
        for picture in video.read_video(film):
            times.append(picture.time_s)
            damaged += picture.damaged
        if damaged:
            notes.append(
                f"{source}: {damaged} of {len(times)} pictures are damaged in the file: copy it again"
            )
        if (late_s := video.find_start(film)) > LATE_START_S:
            notes.append(
                f"{source}: its first picture is {late_s:.3f} s after the start of its file, as "
                "after sound; times "
                f"count from "
                f"{'the start' if film.from_file else 'that picture (--use start=file: from the start)'}"
            )
        return _Film(film), list(range(len(times))), np.array(times, np.float64)
    if source.suffix.lower() in dicom.SUFFIXES:
        open_pictures, count, times_s = dicom.open_dicom(source, notes)
        return open_pictures, list(range(count)), times_s
    if source.suffix.lower() == ".npy":
        frames = np.load(source, mmap_mode="r", allow_pickle=False)
        if frames.ndim not in (3, 4):
            raise UserError(f"{source}: an array of shape {frames.shape}, expected (T, H, W) or (T, H, W, C)")
        return lambda: (np.asarray(picture) for picture in frames), list(range(len(frames))), None
    files = {0: source}
    if source.is_dir():
        stills = [
            path
            for path in file_numbers.find_stills(source, file_numbers.STILLS)
            if fnmatch(path.name, names or "*")
        ]
        if not stills:
            raise UserError(f"{source}: holds no picture {names}")
        files = file_numbers.number_files(stills)
    pages = {path: _count_pages(path) for path in files.values()}
    total, is_stack = sum(pages.values()), max(pages.values()) > 1
    if is_stack:
        notes.append(f"{source}: {total} pages of {len(pages)} TIFF files")
    stamps = None if is_stack else file_numbers.find_stamps(files.values())
    if stamps is not None:
        notes.append(f"{source}: the names are times since 1970")
    return (
        _Stills(pages, files if not is_stack else {}),
        list(range(total)) if is_stack else list(files),
        stamps,
    )


@dataclass(frozen=True)
class _Stills:
    """The pictures of files with so many pages."""

    pages: Mapping[Path, int]
    numbered: Mapping[int, Path]  # empty: stacks

    def __call__(self) -> Iterator[Array]:
        return _read_stills(self.pages)

    def stills(self) -> Mapping[int, Path]:
        return self.numbered


@dataclass(frozen=True)
class _Film:
    """The pictures of a video."""

    file: VideoFile

    def __call__(self) -> Iterator[Array]:
        return (picture.rgb for picture in video.read_video(self.file))


def _choose_film(source: Path, use: Mapping[str, str]) -> VideoFile:
    """A video by the roles `stream` and `start`. UserError: not a number, or another word."""
    stream, start = use.get("stream"), use.get("start", "picture")
    if stream is not None and not stream.isdigit():
        raise UserError(f"--use stream={stream}: the number of a film, from 0")
    if start not in ("picture", "file"):
        raise UserError(f"--use start={start}: picture or file")
    return VideoFile(source, None if stream is None else int(stream), start == "file")


def films_in(folder: Path, names: str | None = None) -> list[Path]:
    """The videos in a folder, in the order of the numbers in their names, without hidden ones."""
    films = [
        path
        for path in folder.glob("*")
        if path.suffix.lower() in video.SUFFIXES and not path.name.startswith(".")
    ]
    return sorted(
        (path for path in films if fnmatch(path.name, names or "*")), key=file_numbers.natural_order
    )


def _open_chapters(
    films: list[Path], use: Mapping[str, str], notes: list[str]
) -> tuple[_Pictures, list[int], Floats | None]:
    """The pictures of videos that follow each other. UserError: they are not of one series, or overlap."""
    series = {re.sub("[0-9]+", "*", path.name.lower()) for path in films}
    gopro = [re.fullmatch(r"g[hxl](\d\d)(\d{4})\..*", path.name.lower()) for path in films]
    takes = {match[2] for match in gopro if match}  # GX020123 is chapter 2 of recording 0123
    if len(series) > 1 or len(takes) > 1:
        names = ", ".join(path.name for path in films[:4])
        raise UserError(
            f"{films[0].parent}: several videos that are no chapters of one recording ({names}): "
            "name them by "
            "--use frames=NAME and, for a second camera, right=NAME"
        )
    times, dates = list[Floats](), list[float | None]()
    for path in films:
        chapter_s = np.array(
            [picture.time_s for picture in video.read_video(_choose_film(path, use))], np.float64
        )
        if not np.isfinite(chapter_s).all() or len(chapter_s) < 2:
            raise UserError(f"{path}: a chapter whose pictures have no times")
        offset_s, step = 0.0, float(np.median(np.diff(chapter_s)))
        if times:
            offset_s = float(times[-1][-1]) + step
            dates.append(video.find_date(path))
            first_date, date = dates[0], dates[-1]
            stated_s = None if first_date is None or date is None else date - first_date
            if stated_s is not None and stated_s > offset_s + _GAP_S:
                notes.append(
                    f"{path.name}: begins {stated_s - offset_s:.1f} s after the end of the one before, "
                    "by its date"
                )
                offset_s = stated_s
        else:
            dates.append(video.find_date(path))
        times.append(offset_s + chapter_s)
    if len(films) > 1:
        ends = ", ".join(
            f"{path.name} from {chapter_s[0]:.2f} s" for path, chapter_s in zip(films, times, strict=True)
        )
        notes.append(f"{len(films)} chapters are joined in order: {ends}")
    all_times = np.concatenate(times)

    def pictures() -> Iterator[Array]:
        for path in films:
            yield from _Film(_choose_film(path, use))()

    return pictures, list(range(len(all_times))), all_times


def _count_pages(path: Path) -> int:
    if path.suffix.lower() not in (".tif", ".tiff"):
        return 1
    checked_file.read_picture(path)  # refuses one that is no picture, or too large
    with Image.open(path) as stack:
        return getattr(stack, "n_frames", 1)


def _read_stills(pages: Mapping[Path, int]) -> Iterator[Array]:
    """Pictures (H, W, 3) of files with so many pages, RGB."""
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR
    for path, count in pages.items():
        for k in range(0, count, _AT_ONCE):
            batch = min(_AT_ONCE, count - k)
            pictures = [checked_file.read_picture(path, flags)]
            if count > 1:
                pictures = [*cv2.imreadmulti(str(path), start=k, count=batch, flags=flags)[1]]
            if len(pictures) < batch:
                raise UserError(f"{path}: page {k + len(pictures)} of {count} is damaged")
            yield from (picture[..., ::-1] for picture in pictures)


def _read_forces(path: Path, columns: str, since_1970: bool, notes: list[str]) -> Readings:
    """Samples of a table, or of a PLUS/IGSIO sequence. UserError as `sensor_table.read_forces`."""
    if path.suffix.lower() in igsio.SUFFIXES:
        return igsio.read_forces(path)
    readings = sensor_table.read_forces(path, columns, since_1970)
    is_filled = np.isfinite(readings.time_s) & np.isfinite(readings.force).any(axis=1)
    if not is_filled.all():
        notes.append(f"{path}: {np.sum(~is_filled)} blank rows are left out")
    return replace(readings, time_s=readings.time_s[is_filled], force=readings.force[is_filled])


def _frame_seconds(path: Path, numbers: list[int], notes: list[str]) -> Floats:
    """Times (T,) s of the pictures with these numbers: by the table's column `frame`, else in its order."""
    time, frames = sensor_table.read_clock(path, notes)
    if frames is not None:
        by_number = dict(zip(frames.tolist(), time, strict=True))
        if by_number.keys() >= set(numbers):
            return np.array([by_number[number] for number in numbers])
    time = time[np.isfinite(time)]
    if len(time) != len(numbers):
        raise UserError(f"{path}: {len(time)} times for {len(numbers)} pictures")
    return time
