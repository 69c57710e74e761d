"""Reader of recordings: a folder with a video, optionally a force sensor's file, and `meta.yaml`.

meta.yaml              scale, stiffness, rest frame, ... (`bench.recording.meta`)
video.mp4 or frames/*.png
frames.csv             optional: frame,t_s      (else the video's own presentation times)
force.csv              optional: t_s,fx_n,fy_n,fz_n; or one axis, as t_s,fz_n; or t_s,f_n, a size
masks/NNNNNN.png       optional: white where the tool is, in the frame of that number
mask.png               optional: the same for all frames that have no mask of their own
tissue.png             optional: white on all tissue in the rest frame; without it found by motion
right.mp4 or right/*.png   optional: the right camera, frame by frame, with `stereo` in meta.yaml
depth/*.png or *.npy   optional: depth (H, W) or points (H, W, 3), frame by frame, with `depth` in meta.yaml

Files of one moment have the same number, in a picture's name and in frames.csv; videos are numbered from 0.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

from bench.recording import meta, sensor_table
from bench.recording.meta import Meta
from bench.recording.recording_scale import PixelScale, find_scale
from synth.arrays import Floats, Mask
from synth.errors import UserError
from synth.flow.recording.stereo_motion import measure_video_scale
from synth.flow.stereo.calibration import read_rig
from synth.job.types import Section
from synth.system import camera_file, csv_table
from synth.video import file_numbers
from synth.video import read_video as video
from synth.video.mask_files import MaskFiles
from synth.video.pixel_scale import UNKNOWN_NOTE
from synth.video.read_video import Picture, VideoFile
from synth.video.suffixes import SUFFIXES

S = TypeVar("S", bound=Section)
Video = VideoFile | dict[int, Path]  # a file, or pictures by the numbers in their names, in order

_LARGEST_FORCE_N = 50.0
LATE_START_S = 2e-3  # of a first picture, from which it is said
_EPOCH_S = 1e8  # three years, longer than any recording: larger times count from 1970


@dataclass(frozen=True)
class Force:
    """The sensor's samples on its own clock, converted in unit and sign only."""

    time_s: Floats  # (N,) strictly rising [s]
    force_mn: Floats  # (N, 3) force on the tissue [mN]; NaN where the file has none
    gravity: Floats | None = None  # (N, 3) unit vector in the sensor's axes: gx, gy, gz


@dataclass(frozen=True)
class Recording:
    """An opened recording; its pictures are not yet decoded."""

    folder: Path
    meta: Meta
    footage: Video
    times_s: Mapping[int, float] | None  # frames.csv [s], by frame number; None without the file
    force: Force | None
    masks: MaskFiles  # of the tool; may be empty
    tissue: Path | None
    notes: tuple[str, ...]  # oddities and how they were handled, for the report
    region: tuple[int, int, int, int] | None = None  # left, top, width, height [px] of the tracked part
    right: Video = field(default_factory=dict)  # right camera; empty: none
    right_frame: Mapping[int, int] = field(default_factory=dict)  # frame of each picture, where known
    depths: Mapping[int, Path] = field(default_factory=dict)  # depth pictures by frame; empty: none
    numbers: Collection[int] = ()  # of the frames, in order; empty if the video's length is unknown

    @property
    def has_stereo(self) -> bool:
        """Whether it has a right camera or a depth camera."""
        return bool(self.right or self.depths)

    @property
    def name(self) -> str:
        return self.folder.resolve().name

    @cached_property
    def scale(self) -> PixelScale:
        """Millimetres per pixel at the tissue, found once. UserError: as of `find_scale`."""
        return find_scale(self.meta, self.folder, self.frames, self._measure_scale)

    def _measure_scale(self) -> float:
        """By both cameras, on the tissue where that is drawn. UserError: as of `measure_video_scale`."""
        assert self.meta.stereo is not None
        path, unit_mm = self.folder / self.meta.stereo.calibration, self.meta.stereo.mm_per_unit
        return measure_video_scale(
            self.frames(),
            self.right_frames(),
            self.meta.rest_frame,
            lambda size: read_rig(path, size[::-1], unit_mm),
            self.tissue_mask if self.tissue or self.region else None,
        )

    def frames(self) -> Iterator[Picture]:
        """Upright frames; times from frames.csv, else the video, else `fps`. UserError: unreadable."""
        fps, by_name = self.meta.fps, dict[int, float]()
        if fps is not None and not isinstance(self.footage, VideoFile):
            by_name = file_numbers.still_times(self.footage, fps, [])
        for picture in _pictures(self.footage):
            time_s = picture.time_s
            if self.times_s is not None:
                time_s = self.times_s.get(picture.index)
            elif time_s is None and fps is not None:
                time_s = by_name.get(picture.index, picture.index / fps)
            yield replace(picture, time_s=time_s)

    def right_frames(self) -> Iterator[Picture]:
        """The right camera's frames in order, with the left frames' numbers. UserError: unreadable."""
        for picture in _pictures(self.right):
            yield replace(picture, index=self.right_frame.get(picture.index, picture.index))

    def describe_tool(self, frames: int) -> str:
        """The source of the tool masks, in words."""
        if not self.masks:
            return "no masks/, no mask.png: the tool is detected in each picture"
        count = len(self.masks.by_frame.keys() & set(self.numbers or self.masks.by_frame))
        if count >= frames:
            return f"masks/ has all {frames} frames"
        others = "mask.png is used for" if self.masks.default else "no tool is assumed in"
        return f"masks/ has {count} of {frames} frames; {others} the others"

    def tissue_mask(self, size: tuple[int, int]) -> Mask:
        """Mask (H, W) of trackable tissue in the rest frame: `tissue.png`, else the whole picture."""
        tissue = np.ones(size, bool) if self.tissue is None else video.read_mask(self.tissue, size)
        if self.region is not None:
            left, top, width, height = self.region
            inside = np.zeros(size, bool)
            inside[top : top + height, left : left + width] = True
            tissue &= inside
        return tissue

    def restrict(self, masks: MaskFiles | None, region: tuple[int, int, int, int] | None) -> Recording:
        """The recording with other tool masks, if given, and restricted to a region (see `region`)."""
        if masks is None:
            return replace(self, region=region)
        notes = list(self.notes)
        masks = masks.of_frames(self.numbers, notes)
        return replace(self, masks=masks, region=region, notes=tuple(notes))


def _pictures(files: Video) -> Iterator[Picture]:
    return video.read_video(files) if isinstance(files, VideoFile) else video.read_pictures(files)


def _numbers(files: Video) -> Collection[int]:
    return range(video.count_frames(files) or 0) if isinstance(files, VideoFile) else files.keys()


def open_recording(folder: Path, phantom: bool = False) -> Recording:
    """Reads everything but the pictures. Times since 1970 are counted from the recording's start.

    `phantom`: whether it shows one, whatever meta.yaml states. UserError for no folder, a bad meta.yaml,
    neither or both of video and frames, or an unusable CSV.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no recording folder; `bench import` converts other systems' files")
    about = meta.read_meta(folder / "meta.yaml")
    if phantom:
        about = about.model_copy(update={"tissue": "phantom"})
    notes: list[str] = []
    footage = _find_video(folder, "video", "frames", about, notes)
    if not footage:
        contents = ", ".join(sorted(path.name for path in folder.iterdir())[:8])
        raise UserError(f"{folder}: neither video.mp4 nor frames/*.png found; it holds {contents}")
    if about.scale_mm_per_px == "unknown":
        about = about.model_copy(update={"young_kpa": None})
        notes.append(UNKNOWN_NOTE)
    frames = _numbers(footage)
    if not isinstance(footage, VideoFile):
        notes += file_numbers.describe_gaps(list(frames), "frames/")
    elif (aspect := video.pixel_aspect(footage)) != 1:
        correction = f"pixels {aspect:.3g} times as wide as high were made square, in width"
        notes.append(f"the video: {correction}; scale and calibration are assumed to be for square pixels")
    times = _frame_times(folder / "frames.csv", frames, notes)
    if times is None and isinstance(footage, VideoFile):
        notes += _describe_start(footage)
    elif times is None and about.fps is not None and not isinstance(footage, VideoFile):
        file_numbers.still_times(footage, about.fps, notes)
    force, axes = _force(folder / "force.csv", about, notes)
    if axes != "xyz":  # without a direction no component can be compared
        about = about.model_copy(update={"sensor": about.sensor.size_only()})
    about, times, force = _count_from_start(about, times, force, notes)
    tissue = folder / "tissue.png" if os.path.lexists(folder / "tissue.png") else None
    right, depths = _find_stereo(folder, about)
    if about.stereo is not None:
        notes += camera_file.describe(folder / about.stereo.calibration)
    right_frame = file_numbers.match_numbers(_numbers(right), frames, "right", notes)
    depth_frame = file_numbers.match_numbers(depths, frames, "depth/", notes)
    by_frame = {depth_frame[number]: path for number, path in depths.items()}
    no_masks = MaskFiles({}, None)
    recording = Recording(
        folder,
        about,
        footage,
        times,
        force,
        no_masks,
        tissue,
        tuple(notes),
        None,
        right,
        right_frame,
        by_frame,
        frames,
    )
    return recording.restrict(MaskFiles.find(folder / "masks", folder), None)


def _describe_start(footage: VideoFile) -> list[str]:
    """A note on a video whose first picture is not at the start of its file."""
    late_s = video.find_start(footage)
    if late_s < LATE_START_S:
        return []
    origin = "the start of its file" if footage.from_file else "that picture"
    return [
        f"{footage.path.name}: its first picture is {late_s:.3f} s after the start of its file, "
        "with which sound or pictures that can't be decoded begin: times count from "
        f"{origin} (start: picture or file in meta.yaml)"
    ]


def _find_stereo(folder: Path, about: Meta) -> tuple[Video, dict[int, Path]]:
    """The right camera's video or pictures, and depth pictures. UserError if meta.yaml does not match."""
    right = _find_video(folder, "right", "right", about, [])
    depths = file_numbers.find_stills(folder / "depth", (".png", ".npy"))
    for pictures, section, key in ((right, about.stereo, "stereo"), (depths, about.depth, "depth")):
        if bool(pictures) != (section is not None):
            raise UserError(
                f"{folder}: right.mp4 or right/*.png requires stereo: in meta.yaml, depth/ requires depth:; "
                f"{key}: or its pictures are missing"
            )
    return right, file_numbers.number_files(depths)


def _find_video(folder: Path, name: str, pictures: str, about: Meta, notes: list[str]) -> Video:
    """The video NAME.*, else the only one, or the pictures in a folder; empty: neither. UserError:
    several."""
    films = sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES)
    films = [path for path in films if not path.name.startswith(".")]
    matches = [path for path in films if path.name.lower().startswith(f"{name}.")]
    stills = file_numbers.number_files(file_numbers.find_stills(folder / pictures, file_numbers.STILLS))
    if not matches and not stills and name == "video":
        others = [path for path in films if not path.stem.lower().startswith("right")]
        if len(others) > 1:
            names = ", ".join(path.name for path in others[:4])
            raise UserError(
                f"{folder}: holds {names}, but no video.mp4: rename the one to be used, or keep only it"
            )
        notes += [f"{path.name} is taken for the video" for path in others]
        matches = others
    if len(matches) > 1:
        names = ", ".join(path.name for path in matches[:4])
        raise UserError(
            f"{folder}: holds {names}; keep one of them. If they are chapters of one recording, "
            "move them into a "
            "folder of their own, and bench import joins it"
        )
    if matches and stills:
        raise UserError(f"{folder}: has {matches[0].name} and pictures in {pictures}/; keep one of them")
    if matches:
        return VideoFile(matches[0], about.stream if name == "video" else None, about.start == "file")
    return stills


def _count_from_start(
    about: Meta, times: dict[int, float] | None, force: Force | None, notes: list[str]
) -> tuple[Meta, dict[int, float] | None, Force | None]:
    """Converts times since 1970, also those of meta.yaml's spans, to times since the first frame."""
    first = next(iter((times or {}).values()), 0.0)
    start = first if first > _EPOCH_S else 0.0
    force_since_1970 = force is not None and bool(force.time_s[0] > _EPOCH_S)
    if force is not None and force_since_1970 != bool(start):
        epoch_file, other_file = (
            ("force.csv", "the video") if force_since_1970 else ("frames.csv", "force.csv")
        )
        notes.append(
            f"{epoch_file} counts from 1970, {other_file} doesn't: the offset between the two is unknown"
        )
        return about, times, force
    if not start:
        return about, times, force
    notes.append(f"times since 1970 are counted from {start:.3f} s")
    if times is not None:
        times = {number: time - start for number, time in times.items()}
    if force is not None:
        force = replace(force, time_s=force.time_s - start)
    return _shift_spans(about, start), times, force


def _shift_spans(about: S, start: float) -> S:
    """A section of meta.yaml with its spans that count from 1970 counted from `start` [s]."""

    def shift(value: object) -> object:
        if isinstance(value, Section):
            return _shift_spans(value, start)
        if not isinstance(value, tuple):
            return value
        since_1970 = len(value) == 2 and isinstance(value[0], float) and value[0] > _EPOCH_S
        return (value[0] - start, value[1] - start) if since_1970 else tuple(map(shift, value))

    return about.model_copy(update={name: shift(value) for name, value in about})


def _frame_times(path: Path, frames: Collection[int], notes: list[str]) -> dict[int, float] | None:
    """Rising times [s] by frame number; `frames`: numbers of the video. UserError for bad numbers."""
    if not os.path.lexists(path):
        return None
    columns = csv_table.read_csv(path, ("frame", "t_s"))
    frame, time = columns["frame"], columns["t_s"]
    number = np.where((frame >= 0) & (frame < 1e8), frame, -1).astype(np.int64)
    is_valid = (number == frame).all() and len(np.unique(number)) == len(number)
    if not is_valid or number.max() > 10 * len(number) + 1000:
        raise UserError(f"{path}: column frame must contain frame numbers, each once")
    frame_of = file_numbers.match_numbers(number.tolist(), frames, path.name, notes)
    times = {frame_of[n]: t for n, t in sorted(zip(number.tolist(), time.tolist(), strict=True)) if t == t}
    if (np.diff(list(times.values())) <= 0).any():
        notes.append(f"{path.name}: times repeat or run backwards; those frames are left out")
    return times


def _rising(time: Floats) -> Mask:
    """Rows (N,) later than all before, or earlier than all after, whichever are more: times that rise, and a
    single wrong one excludes no other."""
    if len(time) == 0:
        return np.zeros(0, bool)
    forward = np.append(True, time[1:] > np.maximum.accumulate(time)[:-1])
    backward = np.append(time[:-1] < np.minimum.accumulate(time[::-1])[-2::-1], True)
    return np.asarray(forward if forward.sum() >= backward.sum() else backward, bool)


def _read_forces(path: Path, notes: list[str]) -> tuple[dict[str, Floats], str]:
    """Columns t_s, fx_n, fy_n, fz_n, and gx, gy, gz if there, and the measured axes. UserError: no unit."""
    forces = ("fx_n", "fy_n", "fz_n")
    if set(csv_table.read_header(path)) >= {"t_s", *forces}:
        return csv_table.read_csv(path, ("t_s", *forces), ("gx", "gy", "gz")), "xyz"
    table = sensor_table.read_forces(path)
    if not table.in_newtons:
        raise UserError(
            f"{path}: the unit of force isn't stated: name its columns fx_n, fy_n, fz_n (or f_n "
            "for a size) if they "
            "are in newtons, as `bench import` writes them"
        )
    notes += [note.replace(str(path), path.name) for note in table.notes]
    columns = dict(zip(("t_s", *forces), (table.time_s, *table.force.T), strict=True))
    if table.gravity is not None:
        columns |= dict(zip(("gx", "gy", "gz"), table.gravity.T, strict=True))
    return columns, table.axes


def _force(path: Path, about: Meta, notes: list[str]) -> tuple[Force | None, str]:
    """The samples, and which axes of them are measured, some of "xyz" or empty for a size."""
    if not os.path.lexists(path):
        return None, "xyz"
    columns, axes = _read_forces(path, notes)
    forces = ("fx_n", "fy_n", "fz_n")
    columns["row"] = np.arange(1.0, len(columns["t_s"]) + 1)
    blank = np.asarray(np.isnan([columns[name] for name in forces]).all(axis=0), bool)
    if 0 < blank.sum() < blank.size:  # rows of other instruments, as in joined tables
        notes.append(f"{path.name}: {blank.sum()} rows without a force left out")
        columns = {name: column[~blank] for name, column in columns.items()}
    for fault, check in (("without a time", np.isfinite), ("whose time repeats or runs backwards", _rising)):
        good = check(columns["t_s"])
        if not good.all():
            notes.append(f"{path.name}: {np.sum(~good)} rows {fault} left out")
        columns = {name: column[good] for name, column in columns.items()}
    newtons = np.stack([columns[name] for name in forces], axis=1)
    is_missing = ~np.isfinite(newtons)
    is_usable = ~is_missing.any(axis=1)
    if is_usable.sum() < 2:
        message = f"{path}: fewer than two rows with a time and three forces"
        for name, empty in zip(forces, is_missing.T, strict=True):
            if empty.any():
                row = columns["row"][empty][0]
                message += f"; {name} is empty in {empty.sum()} of {len(empty)} rows, first in row {row:.0f}"
        raise UserError(message)
    if not is_usable.all():
        notes.append(f"{path.name}: {np.sum(~is_usable)} rows with a missing force are not scored")
        newtons[~is_usable] = np.nan
    largest = float(np.nanmax(np.abs(newtons)))
    if largest > _LARGEST_FORCE_N and about.tissue != "phantom":
        raise UserError(
            f"{path}: force reaches {largest:.4g} N, too much for a brain; are the columns in mN? "
            "(for a phantom: --phantom, or tissue: phantom in meta.yaml)"
        )
    directions = [columns[name] for name in ("gx", "gy", "gz") if name in columns]
    gravity = np.stack(directions, axis=1) if len(directions) == 3 else None
    sign = 1.0 if about.sensor.acts_on == "tissue" else -1.0
    return Force(columns["t_s"], sign * 1000.0 * newtons, gravity), axes
