"""A recording: a folder with a video, perhaps the force sensor's file, and `meta.yaml`.

meta.yaml              scale, stiffness, rest frame, ... (`bench.recording.meta`)
video.mp4 or frames/*.png
frames.csv             optional: frame,t_s      (else the video's own presentation times)
force.csv              optional: t_s,fx_n,fy_n,fz_n
masks/NNNNNN.png       optional: white where the tool is, in the frame of that number
mask.png               optional: the same for all frames that have none of their own
tissue.png             optional: white on all of the tissue, in the rest frame (the rest shows the camera)
right.mp4 or right/*.png   optional: the second eye, frame by frame, with `stereo` in meta.yaml
depth/*.png or *.npy   optional: depth (H, W) or points (H, W, 3), frame by frame, with `depth` in meta.yaml

What is of one moment has the same number, in a picture's name and in frames.csv; a video counts from 0.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.recording import csv_table, meta
from bench.recording.meta import Meta, Span
from synth.errors import UserError
from synth.recording_flow.video_flow import Footage
from synth.video import file_numbers
from synth.video import read as video
from synth.video.mask_files import MaskFiles
from synth.video.pixel_scale import UNKNOWN_NOTE
from synth.video.read import Picture

Film = Path | dict[int, Path]
"""A video, or pictures by the numbers in their names, in order."""

_LARGEST_FORCE_N = 50.0
_EPOCH_S = 1e8  # three years: no recording is as long, so such a time counts from 1970


@dataclass(frozen=True)
class Force:
    """What the sensor's file says, in its own time, unprocessed but for units and sign."""

    time_s: NDArray[np.float64]
    """(N,) strictly rising [s]."""
    force_mn: NDArray[np.float64]
    """(N, 3) force on the tissue [mN]; NaN where the file has none."""
    gravity: NDArray[np.float64] | None = None
    """(N, 3) unit vector of gravity in the sensor's axes, when the file has gx, gy, gz."""


@dataclass(frozen=True)
class Recording:
    """An opened recording. Nothing is decoded yet."""

    folder: Path
    meta: Meta
    footage: Film
    times_s: Mapping[int, float] | None
    """From frames.csv [s], by the frame's number. None without the file."""
    force: Force | None
    masks: MaskFiles
    """Of the tool; there may be none."""
    tissue: Path | None
    notes: tuple[str, ...]
    """What was found odd and how it was taken; every one goes into the report."""
    region: tuple[int, int, int, int] | None = None
    """Left, top, width and height [px] of the part of the picture that is looked at."""
    right: Film = field(default_factory=dict)
    """Of the second eye; empty: none."""
    right_frame: Mapping[int, int] = field(default_factory=dict)
    """Which frame each of them belongs to, where that is known."""
    depths: Mapping[int, Path] = field(default_factory=dict)
    """Depth pictures by the frame; empty: none."""

    @property
    def has_stereo(self) -> bool:
        """Whether a second eye or a depth camera saw it too."""
        return bool(self.right or self.depths)

    @property
    def name(self) -> str:
        return self.folder.resolve().name

    def numbers(self) -> Collection[int]:
        """Of the frames, in order; empty for a video that doesn't say how many. UserError: unreadable."""
        return _numbers(self.footage)

    def frames(self) -> Iterator[Picture]:
        """Upright frames in order, with times.

        Those of frames.csv alone if there is one, else the video's, else by `fps` of meta.yaml.

        Raises:
            UserError: unreadable video or picture.
        """
        first = next(iter(self.numbers()), 0)
        for picture in _pictures(self.footage):
            yield self._timed(picture, first)

    def film(self, pictures: Iterable[Picture] | None = None) -> Footage:
        """The recording for a `VideoFlow`. `pictures`: some of its frames; None: all."""
        tool = self.masks.read if self.masks else None
        frames = self.frames() if pictures is None else pictures
        return Footage(frames, str(self.folder), self.tissue_mask, tool, self.meta.rest_frame)

    def right_frames(self) -> Iterator[Picture]:
        """The second eye's frames in order, with the numbers of the film's; UserError: unreadable."""
        for picture in _pictures(self.right):
            yield replace(picture, index=self.right_frame.get(picture.index, picture.index))

    def describe_tool(self, frames: int) -> str:
        """What is taken for the tool in how many frames, for `bench check` and `bench score` alike."""
        if not self.masks:
            return "no masks/, no mask.png: the tool is looked for in each picture"
        count = len(self.masks.by_frame.keys() & set(self.numbers() or self.masks.by_frame))
        if count >= frames:
            return f"masks/ has all {frames} frames"
        others = "mask.png stands for" if self.masks.default else "no tool is taken to be in"
        return f"masks/ has {count} of {frames} frames; {others} the others"

    def tissue_mask(self, size: tuple[int, int]) -> NDArray[np.bool_]:
        """(H, W) where tissue may be tracked in the rest frame: `tissue.png`, else everywhere."""
        tissue = np.ones(size, bool) if self.tissue is None else video.read_mask(self.tissue, size)
        if self.region is not None:
            left, top, width, height = self.region
            inside = np.zeros(size, bool)
            inside[top : top + height, left : left + width] = True
            tissue &= inside
        return tissue

    def within(self, masks: MaskFiles | None, region: tuple[int, int, int, int] | None) -> Recording:
        """The same with the tool as other files have it, and looked at in a region (see `region`) only."""
        if masks is None:
            return replace(self, region=region)
        notes = list(self.notes)
        masks = masks.of_frames(self.numbers(), notes)
        return replace(self, masks=masks, region=region, notes=tuple(notes))

    def _timed(self, picture: Picture, first: int) -> Picture:
        time_s, fps = picture.time_s, self.meta.fps
        if self.times_s is not None:
            time_s = self.times_s.get(picture.index)
        elif time_s is None and fps is not None:
            time_s = (picture.index - first) / fps
        return replace(picture, time_s=time_s)


def _pictures(film: Film) -> Iterator[Picture]:
    return video.read_video(film) if isinstance(film, Path) else video.read_pictures(film)


def _numbers(film: Film) -> Collection[int]:
    return range(video.count_frames(film) or 0) if isinstance(film, Path) else film.keys()


def open_recording(folder: Path, phantom: bool = False) -> Recording:
    """Reads everything but the pictures. Times since 1970 are brought to the recording's start.

    Args:
        folder: of the recording.
        phantom: it shows one, whatever meta.yaml says of the tissue.

    Raises:
        UserError: no folder, bad meta.yaml, neither or both of video and frames, a CSV that can't be used.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no recording folder; `bench import` makes one of other systems' files")
    about = meta.read_meta(folder / "meta.yaml")
    if phantom:
        about = about.model_copy(update={"tissue": "phantom"})
    footage = _film(folder, "video", "frames")
    if not footage:
        raise UserError(f"{folder}: holds neither video.mp4 nor frames/*.png")
    notes: list[str] = []
    if about.scale_mm_per_px == "unknown":
        about = about.model_copy(update={"young_kpa": None})
        notes.append(UNKNOWN_NOTE)
    frames = _numbers(footage)
    if not isinstance(footage, Path):
        notes += file_numbers.describe_gaps(list(frames), "frames/")
    elif (aspect := video.pixel_aspect(footage)) != 1:
        how = f"pixels {aspect:.3g} times as wide as high were made square, in width"
        notes.append(f"the video: {how}; scale and calibration are taken to be of the square ones")
    times = _frame_times(folder / "frames.csv", frames, notes)
    force = _force(folder / "force.csv", about, notes)
    about, times, force = _from_start(about, times, force, notes)
    tissue = folder / "tissue.png" if os.path.lexists(folder / "tissue.png") else None
    right, depths = _second_eye(folder, about)
    right_frame = file_numbers.match_numbers(_numbers(right), frames, "right", notes)
    depth_frame = file_numbers.match_numbers(depths, frames, "depth/", notes)
    found = Recording(
        folder,
        about,
        footage,
        times,
        force,
        MaskFiles({}, None),
        tissue,
        tuple(notes),
        right=right,
        right_frame=right_frame,
        depths={depth_frame[number]: path for number, path in depths.items()},
    )
    return found.within(MaskFiles.find(folder / "masks", folder), None)


def _second_eye(folder: Path, about: Meta) -> tuple[Film, dict[int, Path]]:
    """Video or pictures of the right eye, and depth pictures; UserError if meta.yaml says otherwise."""
    right = _film(folder, "right", "right")
    depths = [path for path in folder.glob("depth/*") if path.suffix in (".png", ".npy")]
    for found, told, key in ((right, about.stereo, "stereo"), (depths, about.depth, "depth")):
        if bool(found) != (told is not None):
            raise UserError(
                f"{folder}: right.mp4 or right/*.png goes with stereo: in meta.yaml, depth/ with depth:; "
                f"{key}: or its pictures are missing"
            )
    return right, file_numbers.number_files(depths)


def _film(folder: Path, name: str, pictures: str) -> Film:
    """The video NAME.*, or the pictures of a folder; empty: neither. UserError for several."""
    found: list[Film] = [
        path for path in sorted(folder.glob(f"{name}.*")) if path.suffix.lower() in video.SUFFIXES
    ]
    if stills := file_numbers.number_files(list(folder.glob(f"{pictures}/*.png"))):
        found.append(stills)
    if len(found) > 1:
        raise UserError(f"{folder}: holds several of {name}.mp4 and {pictures}/; keep one of them")
    return found[0] if found else {}


def _from_start(
    about: Meta, times: dict[int, float] | None, force: Force | None, notes: list[str]
) -> tuple[Meta, dict[int, float] | None, Force | None]:
    """Times since 1970 counted from the first frame instead, those of meta.yaml's spans among them."""
    first = next(iter((times or {}).values()), 0.0)
    start = first if first > _EPOCH_S else 0.0
    felt = force is not None and bool(force.time_s[0] > _EPOCH_S)
    if force is not None and felt != bool(start):
        one, other = ("force.csv", "the video") if felt else ("frames.csv", "force.csv")
        notes.append(f"{one} counts from 1970, {other} doesn't: nobody can tell where one lies on the other")
        return about, times, force
    if not start:
        return about, times, force
    notes.append(f"times since 1970 are counted from {start:.3f} s on")
    if times is not None:
        times = {number: time - start for number, time in times.items()}
    if force is not None:
        force = replace(force, time_s=force.time_s - start)
    return _spans_from(about, start), times, force


def _spans_from(about: Meta, start: float) -> Meta:
    """The same with the spans that count from 1970 counted from `start` [s] on."""

    def moved(span: Span | None) -> Span | None:
        return span if span is None or span[0] < _EPOCH_S else (span[0] - start, span[1] - start)

    def every(spans: tuple[Span, ...]) -> tuple[Span | None, ...]:
        return tuple(moved(span) for span in spans)

    sync = about.sync.model_copy(update={"calibration_s": moved(about.sync.calibration_s)})
    told = about.sensor
    sensor = told.model_copy(update={"free_s": every(told.free_s), "turn_s": moved(told.turn_s)})
    pulse = about.pulse.model_copy(update={"free_s": every(about.pulse.free_s)})
    parts = {"sync": sync, "sensor": sensor, "pulse": pulse, "press_s": moved(about.press_s)}
    return about.model_copy(update=parts)


def _frame_times(path: Path, frames: Collection[int], notes: list[str]) -> dict[int, float] | None:
    """Seconds by the frame's number, rising; `frames`: the film's. UserError: no numbers, or of another."""
    if not os.path.lexists(path):
        return None
    columns = csv_table.read_csv(path, ("frame", "t_s"))
    frame, time = columns["frame"], columns["t_s"]
    number = np.where((frame >= 0) & (frame < 1e8), frame, -1).astype(np.int64)
    whole = (number == frame).all() and len(np.unique(number)) == len(number)
    if not whole or number.max() > 10 * len(number) + 1000:
        raise UserError(f"{path}: column frame must hold the frames' numbers, each once")
    frame_of = file_numbers.match_numbers(number.tolist(), frames, path.name, notes)
    times = {frame_of[n]: t for n, t in sorted(zip(number.tolist(), time.tolist(), strict=True)) if t == t}
    if (np.diff(list(times.values())) <= 0).any():
        notes.append(f"{path.name}: times stand still or run back; those frames are left out")
    return times


def _rising(time: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) rows kept of a clock that runs back: those at which it reaches new ground.

    Seen from the start or from the end, whichever keeps more: one wrong time must not take all that follow.
    """
    if len(time) == 0:
        return np.zeros(0, bool)
    forward = np.append(True, time[1:] > np.maximum.accumulate(time)[:-1])
    reverse = time[::-1]
    backward = np.append(True, reverse[1:] < np.minimum.accumulate(reverse)[:-1])[::-1]
    return np.asarray(forward if forward.sum() >= backward.sum() else backward, bool)


def _force(path: Path, about: Meta, notes: list[str]) -> Force | None:
    if not os.path.lexists(path):
        return None
    forces = ("fx_n", "fy_n", "fz_n")
    columns = csv_table.read_csv(path, ("t_s", *forces), ("gx", "gy", "gz"))
    columns["row"] = np.arange(1.0, len(columns["t_s"]) + 1)
    for fault, check in (("without a time", np.isfinite), ("whose time stands still or runs back", _rising)):
        good = check(columns["t_s"])
        if not good.all():
            notes.append(f"{path.name}: {np.sum(~good)} rows {fault} left out")
        columns = {name: column[good] for name, column in columns.items()}
    newtons = np.stack([columns[name] for name in forces], axis=1)
    lacking = ~np.isfinite(newtons)
    usable = ~lacking.any(axis=1)
    if usable.sum() < 2:
        few = f"{path}: fewer than two rows with a time and three forces"
        for name, empty in zip(forces, lacking.T, strict=True):
            if empty.any():
                row = columns["row"][empty][0]
                few += (
                    f"; {name} is empty in {empty.sum()} of {len(empty)}, first in row {row:.0f} of the data"
                )
        raise UserError(few)
    if not usable.all():
        notes.append(
            f"{path.name}: {np.sum(~usable)} rows with a missing force; scores leave those times out"
        )
        newtons[~usable] = np.nan
    largest = float(np.nanmax(np.abs(newtons)))
    if largest > _LARGEST_FORCE_N and about.tissue == "brain":
        raise UserError(
            f"{path}: force reaches {largest:.4g} N, more than any brain bears; are the columns in mN? "
            "(of a phantom: --phantom, or tissue: phantom in meta.yaml)"
        )
    gravity = None
    if all(name in columns for name in ("gx", "gy", "gz")):
        gravity = np.stack([columns[name] for name in ("gx", "gy", "gz")], axis=1)
    sign = 1.0 if about.sensor.acts_on == "tissue" else -1.0
    return Force(columns["t_s"], sign * 1000.0 * newtons, gravity)
