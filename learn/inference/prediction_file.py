"""Output of `learn predict` and `bench estimate`.

NAME.npz holds the arrays of `FIELDS`, NAME.force.csv the curve, NAME.force.mp4 the force over the video.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from learn.data.grid import to_image
from learn.inference.predict import length
from learn.inference.video_motion import Motion
from synth.arrays import Floats, Pixels
from synth.dataset.store import open_sequence
from synth.errors import UserError
from synth.publish import picture, sequence_video
from synth.system import checked_file
from synth.system.checked_file import write_whole
from synth.video import read_video as video
from synth.video.write_video import encode_video

_WIDEST_PX = 1280


class PredictedField(NamedTuple):
    """One array of NAME.npz."""

    axes: str
    unit: str
    meaning: str


FIELDS: dict[str, PredictedField] = {
    "frame": PredictedField("T", "-", "number in the video"),
    "time_s": PredictedField("T", "s", "on the video's clock; absent without one"),
    "trusted": PredictedField("T", "-", "whether the frame could be followed"),
    "total_force_mn": PredictedField("T", "mN", "size of the total force on the tissue; NaN if not trusted"),
    "force_mn": PredictedField(
        "T, 3",
        "mN",
        "the force by x right, y down, z away, of a vector model; by physics with one camera it is shorter "
        "than the size, which counts what isn't seen",
    ),
    "density": PredictedField("T, C, N, N", "mN/mm²", "on the grid, nothing subtracted: size or x, y, z"),
    "low_mn": PredictedField("T", "mN", "lower end of the size's 90% interval; these six if fitted"),
    "high_mn": PredictedField("T", "mN", "upper end of the size's 90% interval"),
    "low68_mn": PredictedField("T", "mN", "lower end of the size's 68% interval"),
    "high68_mn": PredictedField("T", "mN", "upper end of the size's 68% interval"),
    "force_low_mn": PredictedField("T, 3", "mN", "lower ends of the components' 90% intervals, camera axes"),
    "force_high_mn": PredictedField("T, 3", "mN", "upper ends of the components' 90% intervals, camera axes"),
    "level": PredictedField("L", "-", "0.9 and 0.68 of the intervals that there are; absent: not calibrated"),
    "mask": PredictedField("N, N", "-", "cells with tissue"),
    "pitch_mm": PredictedField("", "mm", "width of a cell"),
    "scale_mm_per_px": PredictedField("", "mm/px", "of the video's own pixels"),
    "centre_px": PredictedField("2", "px", "x, y of the grid's centre in the video's own pixels, last frame"),
    "centres_px": PredictedField("T, 2", "px", "x, y of the grid's centre by frame"),
    "young_kpa": PredictedField("", "kPa", "Young's modulus; forces are proportional to it"),
    "young_known": PredictedField("", "-", "whether Young's modulus was known; else it is assumed"),
    "notes": PredictedField("K", "-", "warnings about the video and its processing"),
}
"""Every field by name, in the documentation's order."""

_ENDS = ("low_mn", "high_mn")
COLUMNS = ("frame", "time_s", "trusted", "total_force_mn", "force_x_mn", "force_y_mn", "force_z_mn", *_ENDS)
"""Columns of NAME.force.csv; missing values are empty."""


class PredictedFile(NamedTuple):
    """What was written for one video."""

    name: str
    frames: int
    peak_mn: float | None  # None: no frame has a force
    interval_mn: tuple[float, float]  # of 90%, of the peak; NaN: none
    table: Path
    notes: list[str]

    @property
    def text(self) -> str:
        """One line for a terminal."""
        low, high = self.interval_mn
        interval = f" (90%: {low:.3g} to {high:.3g})" if np.isfinite([low, high]).all() else ""
        outcome = (
            "no frame has a force" if self.peak_mn is None else f"peak force {self.peak_mn:.3g} mN{interval}"
        )
        return f"{self.name}: {self.frames} frames, {outcome}; {self.table}"


def summarise(files: Sequence[PredictedFile], out: Path) -> dict[str, Any]:
    """What a command prints as JSON of the files that it wrote into a folder."""
    notes = {file.name: file.notes for file in files}
    return {"out": str(out), "notes": notes, "peak_force_mn": {file.name: file.peak_mn for file in files}}


def predict_files(
    estimate: Callable[[Motion], dict[str, Any]],
    videos: Iterable[Motion],
    source: Path,
    out: Path,
    overlay: bool = False,
) -> Iterator[PredictedFile]:
    """Estimates and writes the forces of each video of a source, one after the other, into the folder `out`.

    `estimate`: the forces of a motion, as of `apply`; `videos`: the source's motions; `overlay`: whether to
    write NAME.force.mp4 where the source has pictures. UserError as those, and for a file that would
    overwrite its source.
    """
    is_single = source.is_file() or source.suffix == ".zarr" or video.is_video(source)
    for motion in videos:
        stem = out / motion.name
        if (file := stem.with_name(f"{stem.name}.npz")).exists() and file.samefile(source):
            raise UserError(f"{file}: is the input and would be overwritten; choose another --out")
        prediction = estimate(motion)
        table = write_prediction(prediction, stem)
        if overlay:
            write_overlay(prediction, source if is_single else source / f"{motion.name}.zarr", stem)
        count, trusted = len(prediction["trusted"]), np.flatnonzero(prediction["trusted"])
        peak, interval, size = None, (np.nan, np.nan), prediction["total_force_mn"]
        if len(trusted):
            strongest = trusted[size[trusted].argmax()]
            peak = float(size[strongest])
            interval = _read_interval(prediction, strongest)
        yield PredictedFile(motion.name, count, peak, interval, table, prediction["notes"].tolist())


def write_prediction(prediction: dict[str, Any], stem: Path) -> Path:
    """Writes `stem`.npz and `stem`.force.csv, each atomically, from the fields that `apply` returns.

    Returns the path of the table.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    with checked_file.part_of(stem.with_name(f"{stem.name}.npz")) as part, part.open("wb") as stream:
        np.savez_compressed(stream, **{name: prediction[name] for name in FIELDS if name in prediction})
    text, file = io.StringIO(), stem.with_name(f"{stem.name}.force.csv")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for t, number in enumerate(prediction["frame"]):
        time = prediction["time_s"][t] if "time_s" in prediction else np.nan
        force = prediction["force_mn"][t] if "force_mn" in prediction else (np.nan,) * 3
        numbers = (time, prediction["total_force_mn"][t], *force, *_read_interval(prediction, t))
        values = [f"{value:.6g}" if np.isfinite(value) else "" for value in numbers]
        table.writerow([int(number), values[0], int(prediction["trusted"][t]), *values[1:]])
    write_whole(file, text.getvalue(), durable=False)
    return file


def _read_interval(prediction: dict[str, Any], t: int) -> tuple[float, float]:
    """Ends of the 90% interval of a frame's force [mN]; NaN: none."""
    low, high = (float(prediction[name][t]) if name in prediction else np.nan for name in _ENDS)
    return low, high


def write_overlay(prediction: dict[str, Any], source: Path, stem: Path) -> Path | None:
    """Writes `stem`.force.mp4: the processed frames with the rest frame's force map and the curve below.

    `prediction`: of `apply`; `source`: a video or a sequence's store. None, without a file, if it has no
    pictures.
    """
    numbers = {int(number) for number in prediction["frame"]}
    if video.is_video(source):
        pictures = (frame.rgb for frame in video.read_frames(source, video.FPS) if frame.index in numbers)
    elif source.suffix == ".zarr":
        sequence = open_sequence(source)
        pictures = (sequence["rgb"][t] for t in sorted(numbers))
    else:
        return None
    times = prediction.get("time_s", np.arange(len(prediction["frame"])) / video.FPS)
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    fps = float(np.clip(1 / step, 1, 120)) if step > 0 else video.FPS
    return encode_video(
        stem.with_name(f"{stem.name}.force.mp4"), _draw_frames(prediction, times, pictures), fps
    )


def _draw_frames(prediction: dict[str, Any], times: Floats, pictures: Iterator[Pixels]) -> Iterator[Pixels]:
    force, size = prediction["total_force_mn"], length(prediction["density"])
    largest, curve = float(np.max(size, initial=0.0)), None
    for t, rgb in enumerate(pictures):
        shrink = max(1, -(-rgb.shape[1] // _WIDEST_PX))
        small = cv2.resize(rgb, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
        small = picture.enlarge(np.asarray(small, np.uint8))
        place = (
            prediction["centres_px"][t],
            float(prediction["scale_mm_per_px"]),
            float(prediction["pitch_mm"]),
        )
        values = to_image(size[t], (rgb.shape[0], rgb.shape[1]), *place)
        values = cv2.resize(values, (small.shape[1], small.shape[0]), interpolation=cv2.INTER_LINEAR)
        if curve is None:
            curve = sequence_video.draw_curve(times, force, small.shape[1])
        assumption = "" if prediction["young_known"] else f", if E is {prediction['young_kpa']:.3g} kPa"
        ends = (
            f" [{prediction['low_mn'][t]:.1f}, {prediction['high_mn'][t]:.1f}]"
            if "low_mn" in prediction
            else ""
        )
        text = f"{force[t]:.1f} mN{ends}{assumption}" if prediction["trusted"][t] else "could not be followed"
        frame = sequence_video.glow(small, values, largest) if prediction["trusted"][t] else small
        frame = picture.caption(frame, f"{times[t]:.2f} s  {text}")
        yield np.vstack([frame, sequence_video.mark(curve, t, len(force))])
