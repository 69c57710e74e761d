"""The photograph beside frames before and after the fit, at equal scale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from synth.errors import UserError
from synth.fit.statistics import Picture, View

_GAP = 6


def write_sheet(path: Path, photograph: View, before: Sequence[View], after: Sequence[View]) -> None:
    """Writes the picture: a column of the photograph's parts, of frames before, of frames after.

    Raises:
        UserError: it can't be written.
    """
    height, width = before[0].rgb.shape[:2]
    columns = [
        _parts(photograph, (height, width), len(before)),
        [v.rgb for v in before],
        [v.rgb for v in after],
    ]
    named = [
        _column(column, name) for column, name in zip(columns, ("photograph", "before", "after"), strict=True)
    ]
    if not cv2.imwrite(str(path), np.hstack(named)[..., ::-1]):
        raise UserError(f"{path}: cannot be written as a picture")


def _parts(photograph: View, size: tuple[int, int], count: int) -> list[Picture]:
    """Parts of the photograph of a frame's size that show most cortex, apart from each other."""
    height, width = size
    rgb = photograph.rgb
    down, across = max(0, height - len(rgb)), max(0, width - rgb.shape[1])
    rgb = np.pad(rgb, ((0, down), (0, across), (0, 0)))
    left = np.pad(photograph.usable, ((0, down), (0, across))).astype(np.uint8)
    parts = []
    for _ in range(count):
        summed = cv2.integral(left)
        inside = (
            summed[height:, width:]
            - summed[:-height, width:]
            - summed[height:, :-width]
            + summed[:-height, :-width]
        )
        y, x = np.unravel_index(int(np.argmax(inside)), inside.shape)
        parts.append(rgb[y : y + height, x : x + width])
        left[y : y + height, x : x + width] = 0
    return parts


def _column(pictures: list[Picture], name: str) -> Picture:
    framed = [np.pad(one, ((_GAP, _GAP), (_GAP, _GAP), (0, 0))) for one in pictures]
    column = np.vstack([np.zeros((24, framed[0].shape[1], 3), np.uint8), *framed])
    cv2.putText(column, name, (_GAP, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(column, np.uint8)
