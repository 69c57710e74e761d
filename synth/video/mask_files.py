"""Masks of the tool that lie in files: a picture a frame, or one for all frames."""

from __future__ import annotations

import os
import re
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.video.file_numbers import match_numbers, number_files
from synth.video.read import read_mask

MASKS = {
    "auto": "what is found and proves useful",
    "glare": "all highlights that are found",
    "tool": "all that is taken for a tool",
    "both": "both, whatever they do",
    "none": "nothing",
}
"""What is masked; a tool whose outline is given is masked in any case but `glare` and `none`."""


@dataclass(frozen=True)
class MaskFiles:
    """Pictures, white where the tool is."""

    by_frame: dict[int, Path]
    default: Path | None
    """For frames that have none of their own."""

    @classmethod
    def find(cls, numbered: Path, folder: Path) -> MaskFiles:
        """Pictures with a frame's number in their names in `numbered`, and mask.png in `folder`, if any."""
        files = [path for path in numbered.glob("*.png") if re.search("[0-9]", path.stem)]
        default = folder / "mask.png"
        return cls(number_files(files), default if os.path.lexists(default) else None)

    def of_frames(self, frames: Collection[int], notes: list[str]) -> MaskFiles:
        """The same with a film's numbers; arguments and errors as of `match_numbers`."""
        frame_of = match_numbers(self.by_frame, frames, "masks/", notes)
        return replace(self, by_frame={frame_of[number]: path for number, path in self.by_frame.items()})

    def __bool__(self) -> bool:
        return bool(self.by_frame) or self.default is not None

    def read(self, index: int, size: tuple[int, int]) -> NDArray[np.bool_] | None:
        """(H, W) of a frame, None if there is none for it. UserError for one of another size."""
        path = self.by_frame.get(index, self.default)
        return None if path is None else read_mask(path, size)


def read_choice(text: str) -> tuple[str, MaskFiles | None]:
    """What `--masks` gives: one of `MASKS`, or a folder. UserError for a folder without masks."""
    if text in MASKS:
        return text, None
    files = MaskFiles.find(Path(text), Path(text))
    if not files:
        raise UserError(f"{text}: holds neither masks NNNNNN.png nor mask.png")
    return "auto", files
