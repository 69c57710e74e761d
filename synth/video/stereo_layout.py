"""Two cameras in one video: recognised in its first pictures, and split."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from synth.arrays import Array, Pixels

LAYOUTS = ("side-by-side", "top-bottom", "half-width", "half-height", "alternating")
"""Side by side, one over the other, both also squeezed to half, and frame by frame in turn; left first."""

PICTURES = 9  # at the start of a video, by which it is judged

# Chosen by hand between renders and photographs, and pairs of them.
_COLUMNS, _BLOCK, _ROWS = 160, 24, 4  # px: width of the reduced halves, side of a block, rows searched
_ALIKE, _BETTER = 0.7, 0.1  # least correlation of a block in the other half; more than elsewhere in its own
_DETAIL = 4.0  # grey levels, least standard deviation of a block
_BLOCKS, _SHARE = 8, 0.4  # least number of blocks with detail, and share of them found about as far aside,
_CERTAIN = 0.75  # or this if the picture goes on from half to half, as a periodic one does:
_STEP, _DARK = 1.5, 2.0  # least step between halves over those nearby; less of them is dark [grey levels]
_AGAIN, _ASIDE = 0.6, 1.0  # in turn: largest change to the next but one over that to the next; disparity [px]


def find_layout(pictures: Sequence[Pixels]) -> str:
    """The layout, one of `LAYOUTS`, of a video with these first pictures (H, W, 3); empty: one camera."""
    stored = (cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY) for rgb in pictures)
    grey = [one.astype(np.float32) for one in stored]
    height, width = grey[0].shape
    for axis, whole, squeezed in ((1, "side-by-side", "half-width"), (0, "top-bottom", "half-height")):
        half, (share, _) = grey[0].shape[axis] // 2, match(*split(grey[0], whole))
        if share > _SHARE:
            lines = np.moveaxis(grey[0], axis, 0)
            steps = np.abs(lines[3:] - lines[:-3]).mean(axis=1)[max(half - 12, 0) : half + 10]
            goes_on = _DARK < np.median(steps) > np.median(steps[9:11]) / _STEP
            if share > _CERTAIN or not goes_on:
                return squeezed if (width < 2 * height if axis else width > height) else whole
    fine = [one - cv2.GaussianBlur(one, (0, 0), 3) for one in grey]
    changes = [[np.abs(a - b).mean() for a, b in zip(fine, fine[k:], strict=False)] for k in (1, 2)]
    if len(fine) < 5 or np.median(changes[1]) > _AGAIN * np.median(changes[0]):
        return ""
    share, aside = match(grey[0], grey[1], 2 * _COLUMNS)
    return "alternating" if share > _SHARE and aside >= _ASIDE else ""


def split(rgb: Pixels, layout: str) -> tuple[Pixels, Pixels]:
    """The two cameras' pictures (h, w, 3) in one of a layout, not `alternating`; squeezed ones stretched."""
    axis = 0 if layout in ("top-bottom", "half-height") else 1
    half = rgb.shape[axis] // 2
    one, other = np.split(rgb.take(range(2 * half), axis), 2, axis)
    if layout.startswith("half"):
        size = one.shape[1] * (1 + axis), one.shape[0] * (2 - axis)
        one, other = (cv2.resize(part, size, interpolation=cv2.INTER_CUBIC) for part in (one, other))
    return one, other


def match(one: Array, other: Array, columns: int = _COLUMNS) -> tuple[float, float]:
    """Share of blocks of a picture (H, W) that are in another about equally far aside, and how far [px]."""
    shrink = max(1.0, one.shape[1] / columns)
    size = round(one.shape[1] / shrink), round(one.shape[0] / shrink)
    one, other = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in (one, other))
    count, found = 0, list[int]()
    for y in range(_ROWS, size[1] - _BLOCK - _ROWS + 1, _BLOCK // 2):
        rows = slice(y - _ROWS, y + _BLOCK + _ROWS)
        for x in range(0, size[0] - _BLOCK + 1, _BLOCK // 2):
            block = one[y : y + _BLOCK, x : x + _BLOCK]
            if block.std() < _DETAIL:
                continue
            count += 1
            scores = (cv2.matchTemplate(both[rows], block, cv2.TM_CCOEFF_NORMED) for both in (one, other))
            own, there = (score.max(axis=0) for score in scores)
            own[max(0, x - _BLOCK // 2) : x + _BLOCK // 2] = 0
            if there.max() > max(_ALIKE, own.max() + _BETTER):
                found.append(int(there.argmax()) - x)
    if count < _BLOCKS or not found:
        return 0.0, 0.0
    near = np.abs(np.array(found) - np.median(found)) < size[0] / 12
    return float(near.sum() / count), float(np.percentile(np.abs(found), 90))
