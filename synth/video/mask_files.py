"""Masks of the tool that lie in files: a picture a frame, or one for all frames."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
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

    numbered: dict[int, Path]
    """By frame."""
    still: Path | None
    """For frames that have none of their own."""

    @classmethod
    def find(cls, folder: Path, beside: Path) -> MaskFiles:
        """NNNNNN.png in a folder, and mask.png in another; there may be none."""
        numbered = [path for path in sorted(folder.glob("*.png")) if re.fullmatch("[0-9]{1,9}", path.stem)]
        still = beside / "mask.png"
        by_frame = {int(path.stem): path for path in numbered}
        return cls(by_frame, still if os.path.lexists(still) else None)

    @classmethod
    def of_folder(cls, folder: Path) -> MaskFiles:
        """Both in one folder. UserError if it holds neither."""
        found = cls.find(folder, folder)
        if not found:
            raise UserError(f"{folder}: holds neither masks NNNNNN.png nor mask.png")
        return found

    def __bool__(self) -> bool:
        return bool(self.numbered) or self.still is not None

    def read(self, index: int, size: tuple[int, int]) -> NDArray[np.bool_] | None:
        """(H, W) of a frame, None if there is none for it. UserError for one of another size."""
        path = self.numbered.get(index, self.still)
        return None if path is None else read_mask(path, size)


def read_choice(text: str) -> tuple[str, MaskFiles | None]:
    """What `--masks` says: one of `MASKS`, or a folder. UserError for a folder without masks."""
    return (text, None) if text in MASKS else ("auto", MaskFiles.of_folder(Path(text)))
