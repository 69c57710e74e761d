"""Numbers of frames in the names of files, and how those of one folder belong to those of another."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from synth.errors import UserError

_SPARSE = 10  # numbers spread wider, and by `_SPARE` more, are times of day or the like
_SPARE = 1000


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Key that sorts names by the numbers in them: a2 before a10."""
    parts = re.split("([0-9]+)", path.stem)  # every second is a number
    return [(int(part), "") if k % 2 else (-1, part) for k, part in enumerate(parts)]


def number_files(paths: Collection[Path]) -> dict[int, Path]:
    """Files by the last number in their names that rises from each to the next, else by their place."""
    ordered = sorted(paths, key=natural_order)
    found = [[int(part) for part in re.findall("[0-9]+", path.stem)[::-1]] for path in ordered]
    for numbers in zip(*found, strict=False):  # as many as every name has
        rising = all(a < b for a, b in pairwise(numbers))
        if rising and numbers[-1] - numbers[0] <= _SPARSE * len(numbers) + _SPARE:
            return dict(zip(numbers, ordered, strict=True))
    return dict(enumerate(ordered))


def match_numbers(
    numbers: Collection[int], frames: Collection[int], name: str, notes: list[str]
) -> dict[int, int]:
    """The frame that each number stands for: the one of that number, unless the two count differently.

    Args:
        numbers: of files or rows, as they stand there.
        frames: of the film; empty: nobody knows them.
        name: of what is numbered, for messages.
        notes: gets a line where numbers and frames are as many and equally spaced, but not the same.

    Raises:
        UserError: numbers lie beyond the film's, and neither end agrees.
    """
    own, film = np.unique(list(numbers)), np.unique(list(frames))
    same = dict(zip(own.tolist(), own.tolist(), strict=True))
    if not len(own) or not len(film) or np.isin(own, film).all():
        return same
    across, along = own - own[0], film - film[0]
    if len(own) == len(film) and (across * along[-1] == along * across[-1]).all():
        notes.append(f"{name} counts from {own[0]} to {own[-1]}, the film {film[0]} to {film[-1]}: in order")
        return dict(zip(own.tolist(), film.tolist(), strict=True))
    # Beyond one end only, pictures were lost there, or the film is cut off; but one end from 0 and the other
    # from 1 may be two ways to count.
    recounted = own[0] == 0 and film[0] == 1
    inside = own[0] > film[0] and own[-1] < film[-1]
    if own[0] == film[0] or inside or (own[-1] == film[-1] and not recounted):
        return same
    raise UserError(
        f"{name} counts from {own[0]} to {own[-1]} ({len(own)}), the film from {film[0]} to {film[-1]} "
        f"({len(film)}): which belongs to which? Give what is of one moment the same number"
    )


def describe_gaps(numbers: Sequence[int], name: str) -> list[str]:
    """A line on numbers (rising) that are missing between the others, none where they are evenly spaced."""
    steps = np.diff(np.array(numbers, np.int64))
    if not len(steps) or (steps == steps[0]).all():
        return []
    lost = sorted(set(range(numbers[0], numbers[-1])) - set(numbers))
    some = ", ".join(map(str, lost[:5])) + (", ..." if len(lost) > 5 else "")
    return [f"{name} lacks {len(lost)} of the numbers {numbers[0]} to {numbers[-1]} ({some}): gaps"]
