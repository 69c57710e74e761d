"""Instrument masks in files: a picture per frame, or one for all frames."""

from __future__ import annotations

import os
import re
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

from synth.arrays import Mask
from synth.errors import UserError
from synth.video.file_numbers import find_stills, match_numbers, number_files
from synth.video.read_video import read_mask

MASKS = {
    "auto": "instruments and other objects, detected unless masks are given; detected highlights",
    "none": "nothing",
}
"""What is masked."""


@dataclass(frozen=True)
class MaskFiles:
    """Pictures that are white on the instrument."""

    by_frame: dict[int, Path]
    default: Path | None  # for frames without a mask of their own

    @classmethod
    def find(cls, numbered: Path, folder: Path) -> MaskFiles:
        """PNG files with a number in their names in `numbered`, and mask.png in `folder`, if present."""
        files = [path for path in find_stills(numbered) if re.search("[0-9]", path.stem)]
        default = folder / "mask.png"
        return cls(number_files(files), default if os.path.lexists(default) else None)

    def of_frames(self, frames: Collection[int], notes: list[str]) -> MaskFiles:
        """The same by the frames of a video; arguments and errors as `match_numbers`."""
        frame_of = match_numbers(self.by_frame, frames, "masks/", notes)
        return replace(self, by_frame={frame_of[number]: path for number, path in self.by_frame.items()})

    def __bool__(self) -> bool:
        return bool(self.by_frame) or self.default is not None

    def read(self, index: int, size: tuple[int, int]) -> Mask | None:
        """The mask (H, W) of a frame, None if there is none. UserError for another size."""
        path = self.by_frame.get(index, self.default)
        return None if path is None else read_mask(path, size)


def read_choice(text: str) -> tuple[str, MaskFiles | None]:
    """Parses `--masks`: one of `MASKS`, or a folder. UserError for a folder without masks."""
    if text in MASKS:
        return text, None
    files = MaskFiles.find(Path(text), Path(text))
    if not files:
        raise UserError(f"{text}: holds neither masks NNNNNN.png nor mask.png")
    return "auto", files
