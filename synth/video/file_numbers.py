"""Frame numbers in the names of files, and the matching of two sets of frame numbers."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError

STILLS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
"""Suffixes of still pictures."""
_SEVERAL = "{}: holds {}: keep one series of names (bench import: --use frames='{}')"
_SINCE_1970_S = 900_000_000, 5_000_000_000  # of the years 1998 to 2128
_SAME_STEP = 0.03  # of a step to a frame's interval: names are rounded to whole units
_SPARSE, _SPARE = 10, 1000  # n numbers that span more than 10 n + 1000 are not frame numbers but e.g. times


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Sorting key of names by the numbers in them: a2 before a10."""
    parts = re.split("([0-9]+)", path.stem)  # every second one is a number
    return [(int(part), "") if k % 2 else (-1, part) for k, part in enumerate(parts)]


def find_stills(folder: Path, suffixes: Collection[str] = (".png",)) -> list[Path]:
    """A folder's files with one of the suffixes in any case, without hidden ones such as macOS's `._*`."""
    return [p for p in folder.glob("*") if p.suffix.lower() in suffixes and not p.name.startswith(".")]


def number_files(paths: Collection[Path]) -> dict[int, Path]:
    """Files by the last number in their names that rises from file to file, else by position.

    UserError for several series of names, as of two cameras or two formats.
    """
    ordered = sorted(paths, key=natural_order)
    series = Counter(re.sub("[0-9]+", "*", path.name) for path in ordered).most_common(3)
    if len(series) > 1 and any("*" in name for name, _ in series):
        series_text = ", ".join(f"{count} {name}" for name, count in series)
        raise UserError(_SEVERAL.format(ordered[0].parent, series_text, series[0][0]))
    number_lists = [[int(part) for part in re.findall("[0-9]+", path.stem)[::-1]] for path in ordered]
    columns = [*zip(*number_lists, strict=False)]  # only as many as every name has
    for numbers in columns:
        rising = all(a < b for a, b in pairwise(numbers))
        if rising and numbers[-1] - numbers[0] <= _SPARSE * len(numbers) + _SPARE:
            return dict(zip(numbers, ordered, strict=True))
    if columns and set(Counter(columns[0]).values()) == {len(set(columns[-1]))} != {1}:
        first = re.sub("([0-9]+)(.*)", r"\1*", ordered[0].stem) + ordered[0].suffix
        raise UserError(_SEVERAL.format(ordered[0].parent, "each number several times", first))
    return dict(enumerate(ordered))


def still_times(files: Mapping[int, Path], fps: float, notes: list[str]) -> dict[int, float]:
    """Times [s] of numbered pictures from the first one: by the numbers in their names at `fps` a second.

    Numbers that step by a frame's milliseconds, or micro- or nanoseconds, are times. `notes` receives a line
    if they do, or if they step by more than one, or are not those of frames.
    """
    keys = np.array([*files], np.int64)
    last = [int(part) for path in files.values() for part in re.findall("[0-9]+", path.stem)[-1:]]
    names = np.array(last if len(last) == len(keys) else keys, object)
    steps = np.diff(names)
    if len(steps) and (steps > 0).all() and (step := float(np.median(steps))) > 1:
        for unit, word in ((1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds")):
            if abs(step * unit * fps - 1) < _SAME_STEP:
                notes.append(f"the numbers in the pictures' names step by {step:g}: taken for {word}")
                seconds = [float(number - names[0]) * unit for number in names]
                return dict(zip(keys.tolist(), seconds, strict=True))
    steps = np.diff(keys)
    if len(steps) and steps[0] > 1 and (steps == steps[0]).all():
        notes.append(
            f"the pictures' numbers step by {steps[0]}: taken for every {steps[0]}th frame at "
            f"{fps:g} a second"
        )
    elif len(last) == len(keys) and 0 in files and last != keys.tolist():
        notes.append("the names' numbers are not those of frames: in order, evenly spaced")
    return {key: (key - int(keys[0])) / fps for key in keys.tolist()}


def find_stamps(paths: Collection[Path]) -> Floats | None:
    """Times since 1970 [s] that are the last numbers in names, (N,); None: they are no such times."""
    last = [int(part) for path in paths for part in re.findall("[0-9]+", path.stem)[-1:]]
    if not last or len(last) != len(paths):
        return None
    least, most = _SINCE_1970_S
    for per_second in (1, 1000, 10**6, 10**9):
        if all(least * per_second < number < most * per_second for number in last):
            seconds = np.array([number // per_second for number in last], np.float64)
            return seconds + np.array([number % per_second for number in last], np.float64) / per_second
    return None


def match_numbers(
    numbers: Collection[int], frames: Collection[int], name: str, notes: list[str]
) -> dict[int, int]:
    """The frame of each number of files or rows called `name`: the same one, unless they are counted
    differently.

    `frames`: of the video, empty if unknown; `notes` receives a line if as many numbers, equally spaced,
    differ. UserError: some are not frames, and neither the first nor the last ones agree.
    """
    indices, video = np.unique(list(numbers)), np.unique(list(frames))
    same = dict(zip(indices.tolist(), indices.tolist(), strict=True))
    if not len(indices) or not len(video) or np.isin(indices, video).all():
        return same
    index_offsets, video_offsets = indices - indices[0], video - video[0]
    if (
        len(indices) == len(video)
        and (index_offsets * video_offsets[-1] == video_offsets * index_offsets[-1]).all()
    ):
        notes.append(
            f"{name} has numbers {indices[0]} to {indices[-1]}, the video {video[0]} to {video[-1]}: "
            "matched in order"
        )
        return dict(zip(indices.tolist(), video.tolist(), strict=True))
    # If the numbers exceed the video at one end only, frames are missing there or the video is truncated. But
    # if one begins at 0 and the other at 1, they may be counted differently.
    recounted = indices[0] == 0 and video[0] == 1
    inside = indices[0] > video[0] and indices[-1] < video[-1]
    if indices[0] == video[0] or inside or (indices[-1] == video[-1] and not recounted):
        return same
    raise UserError(
        f"{name} has numbers {indices[0]} to {indices[-1]} ({len(indices)}), the video frames "
        f"{video[0]} to {video[-1]} ({len(video)}): they can't be matched; "
        "give files and frames of one moment the same number"
    )


def describe_gaps(numbers: Sequence[int], name: str) -> list[str]:
    """A line on numbers missing between the others (rising), none if they are evenly spaced."""
    steps = np.diff(np.array(numbers, np.int64))
    if not len(steps) or (steps == steps[0]).all():
        return []
    missing = sorted(set(range(numbers[0], numbers[-1])) - set(numbers))
    examples = ", ".join(map(str, missing[:5])) + (", ..." if len(missing) > 5 else "")
    return [f"{name} lacks {len(missing)} of the numbers {numbers[0]} to {numbers[-1]} ({examples}): gaps"]
