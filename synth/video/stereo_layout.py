"""Two cameras in one video: recognised in its first pictures, and split."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import cv2
import numpy as np

from synth.arrays import Array, Pixels

LAYOUTS = ("side-by-side", "top-bottom", "half-width", "half-height", "alternating", "rows", "columns")
"""Side by side, one over the other, both also squeezed to half, frame by frame in turn, and in every other
row or column; left first."""
MIXED = {
    "checkerboard": "two cameras as a checkerboard, which are not taken apart: record them side by side",
    "anaglyph": "two cameras by colour (anaglyph), which can't be taken apart: record them side by side",
}
"""Layouts that are recognised but not split, and why."""

PICTURES = 9  # at the start of a video, by which it is judged

# Chosen by hand between renders and photographs, and pairs of them.
_COLUMNS, _BLOCK, _ROWS = 160, 24, 4  # px: width of the reduced halves, side of a block, rows searched
_ALIKE, _BETTER = 0.7, 0.1  # least correlation of a block in the other half; more than elsewhere in its own
_DETAIL = 4.0  # grey levels, least standard deviation of a block
_BLOCKS, _SHARE = 8, 0.4  # least number of blocks with detail, and share of them found about as far aside,
_CERTAIN = 0.75  # or this if the picture goes on from half to half, as a periodic one does:
_STEP, _DARK = 1.5, 2.0  # least step between halves over those nearby; less of them is dark [grey levels]
# Mixed: least shares and shifts of the pictures of every second pixel; their least correlation and detail;
# largest motion from picture to picture over the shift of two fields.
_SURE, _FOUND, _FLAT, _FIELDS = np.array([0.35, 2.0]), 0.7, 0.3, 1.5
_FINEST = {"rows": (0.5, 0.0), "columns": (0.0, 0.5), "checkerboard": (0.5, 0.5)}  # cycles a pixel, y and x
_NEAR, _REPLICA = 0.1, 0.2  # pairs of photographs in turn have 0.5 and more of the power, stripes up to 0.11
_REPEATS = 0.9  # correlation of a block with its own surroundings from which it is periodic
_AGAIN, _ASIDE = 0.6, 1.0  # in turn: largest change to the next but one over that to the next; disparity [px]


def find_layout(pictures: Sequence[Pixels]) -> str:
    """The layout, one of `LAYOUTS`, of a video with these first pictures (H, W, 3); empty: one camera."""
    grey_8bit = (cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY) for rgb in pictures)
    grey = [picture.astype(np.float32) for picture in grey_8bit]
    height, width = grey[0].shape
    for axis, layout, squeezed_layout in (
        (1, "side-by-side", "half-width"),
        (0, "top-bottom", "half-height"),
    ):
        half, (share, _) = grey[0].shape[axis] // 2, match(*split(grey[0], layout))
        if share > _SHARE:
            lines = np.moveaxis(grey[0], axis, 0)
            steps = np.abs(lines[3:] - lines[:-3]).mean(axis=1)[max(half - 12, 0) : half + 10]
            goes_on = _DARK < np.median(steps) > np.median(steps[9:11]) / _STEP
            if share > _CERTAIN or not goes_on:
                return squeezed_layout if (width < 2 * height if axis else width > height) else layout
    details = [picture - cv2.GaussianBlur(picture, (0, 0), 3) for picture in grey]
    changes = [[np.abs(a - b).mean() for a, b in zip(details, details[k:], strict=False)] for k in (1, 2)]
    if len(details) >= 5 and np.median(changes[1]) <= _AGAIN * np.median(changes[0]):
        share, aside = match(grey[0], grey[1], 2 * _COLUMNS)
        if share > _SHARE and aside >= _ASIDE:
            return "alternating"
    return _find_mixed(pictures)


def _find_mixed(pictures: Sequence[Pixels]) -> str:
    """The layout of two cameras in every other row, column, pixel or colour of all pictures; empty: none.

    Of the four pictures of every second pixel, two pairs are then of one camera each. Two fields of an
    interlaced video differ likewise where the picture moves, but by half as much as from picture to picture.
    """
    layout, later_indices = _detect_mixed(pictures[0]), {len(pictures) // 2, len(pictures) - 1} - {0}
    if not layout or any(_detect_mixed(pictures[k]) != layout for k in later_indices):
        return ""
    if layout == "rows" and len(pictures) > 1:
        fields = [[_smooth(rgb[k::2, ::2, 1]) for k in (0, 1)] for rgb in pictures[:3]]
        field_shifts = [_shift(even, odd)[1] for even, odd in fields]
        frame_shifts = [_shift(a[0], b[0])[1] for a, b in itertools.pairwise(fields)]
        if max(frame_shifts) > _FIELDS * min(field_shifts):
            return ""
    return layout


def _detect_mixed(rgb: Pixels) -> str:
    height, width = rgb.shape[0] // 2 * 2, rgb.shape[1] // 2 * 2
    channel = rgb[:height, :width, 1]
    first, right, below, across = (_smooth(channel[k::2, j::2]) for k in (0, 1) for j in (0, 1))
    differences = [_differ(first, right), _differ(first, below)]
    if any(differences):  # else it is none of these
        differences.append(_differ(first, across))
    for name, pattern in (("rows", [0, 1, 1]), ("columns", [1, 0, 1]), ("checkerboard", [1, 1, 0])):
        if differences == pattern:
            return name if _finest_power(channel, _FINEST[name]) > _REPLICA else ""
    red, green, blue = (_smooth(rgb[..., k], 4.0) for k in range(3))
    by_colour = _differ(red, green) and _differ(red, blue) and not _differ(green, blue)
    return "anaglyph" if by_colour else ""


def _differ(first: Array, second: Array) -> bool:
    return bool(np.all(_shift(first, second) >= _SURE))


def _finest_power(channel: Array, place: tuple[float, float]) -> float:
    """Power of a channel (H, W) near a frequency (y, x) in cycles a pixel, over all that is far from both it
    and 0.

    Every second pixel of another camera repeats the difference of the cameras' pictures, which is mostly
    coarse, at the finest frequency. Stripes of a few pixels, which beat with every second pixel, are between.
    """
    grey = channel.astype(np.float32) - float(channel.mean())
    window = np.outer(np.hanning(grey.shape[0]), np.hanning(grey.shape[1]))
    power = np.abs(np.fft.fft2(grey * window)) ** 2
    y, x = np.abs(np.fft.fftfreq(grey.shape[0]))[:, None], np.abs(np.fft.fftfreq(grey.shape[1]))
    coarse, finest = np.hypot(y, x) < _NEAR, np.hypot(y - place[0], x - place[1]) < _NEAR
    return float(power[finest].sum() / max(power[~coarse & ~finest].sum(), 1e-9))


def _smooth(channel: Array, coarse: float = 3.0) -> Array:
    """Detail (H, W) of a channel, with unit standard deviation."""
    grey = channel.astype(np.float32)
    fine = cv2.GaussianBlur(grey, (0, 0), 1.0) - cv2.GaussianBlur(grey, (0, 0), coarse)
    return np.asarray(fine / max(float(fine.std()), 1e-6), np.float32)


def _shift(first: Array, second: Array) -> Array:
    """Share of blocks of a picture (H, W) that are found aside in another but not in place, and the 75th
    percentile of how far [px]."""
    shrink = max(1.0, first.shape[1] / (2 * _COLUMNS))
    size = round(first.shape[1] / shrink), round(first.shape[0] / shrink)
    first, second = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in (first, second))
    count, shifts, reach = 0, list[int](), max(6, size[0] // 12)
    for y in range(1, size[1] - _BLOCK, _BLOCK // 2):
        for x in range(reach, size[0] - _BLOCK - reach + 1, _BLOCK // 2):
            block = first[y : y + _BLOCK, x : x + _BLOCK]
            if block.std() < _FLAT:
                continue
            self_scores = cv2.matchTemplate(
                first[y : y + _BLOCK, x - reach : x + _BLOCK + reach], block, cv2.TM_CCOEFF_NORMED
            )
            self_scores[:, reach - 2 : reach + 3] = 0
            if self_scores.max() > _REPEATS:  # stripes are found everywhere
                continue
            count += 1
            surroundings = second[y - 1 : y + _BLOCK + 1, x - reach : x + _BLOCK + reach]
            scores = cv2.matchTemplate(surroundings, block, cv2.TM_CCOEFF_NORMED).max(axis=0)
            in_place = scores[reach - 1 : reach + 2].max()
            if scores.max() > max(_FOUND, in_place + _BETTER):
                shifts.append(abs(int(scores.argmax()) - reach))
    if count < _BLOCKS or not shifts:
        return np.zeros(2)
    return np.array([len(shifts) / count, float(np.percentile(shifts, 75))])


def split(rgb: Pixels, layout: str) -> tuple[Pixels, Pixels]:
    """The two cameras' pictures (h, w, 3) in one of a layout, not `alternating`; squeezed ones stretched."""
    if layout in ("rows", "columns"):
        return _split_lines(rgb, 0, layout), _split_lines(rgb, 1, layout)
    axis = 0 if layout in ("top-bottom", "half-height") else 1
    half = rgb.shape[axis] // 2
    left, right = np.split(rgb.take(range(2 * half), axis), 2, axis)
    if layout.startswith("half"):
        size = left.shape[1] * (1 + axis), left.shape[0] * (2 - axis)
        left, right = (cv2.resize(part, size, interpolation=cv2.INTER_CUBIC) for part in (left, right))
    return left, right


def _split_lines(rgb: Pixels, first: int, layout: str) -> Pixels:
    """The picture (H, W, 3) of every other row or column, from the first, with the others in between."""
    lines = rgb[first::2] if layout == "rows" else rgb[:, first::2]
    y, x = np.mgrid[: rgb.shape[0], : rgb.shape[1]].astype(np.float32)
    x, y = (x, (y - first) / 2) if layout == "rows" else ((x - first) / 2, y)
    return np.asarray(cv2.remap(lines, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def match(first: Array, second: Array, columns: int = _COLUMNS) -> tuple[float, float]:
    """Share of blocks of a picture (H, W) that are in another about equally far aside, and how far [px]."""
    shrink = max(1.0, first.shape[1] / columns)
    size = round(first.shape[1] / shrink), round(first.shape[0] / shrink)
    first, second = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in (first, second))
    count, shifts = 0, list[int]()
    for y in range(_ROWS, size[1] - _BLOCK - _ROWS + 1, _BLOCK // 2):
        rows = slice(y - _ROWS, y + _BLOCK + _ROWS)
        for x in range(0, size[0] - _BLOCK + 1, _BLOCK // 2):
            block = first[y : y + _BLOCK, x : x + _BLOCK]
            if block.std() < _DETAIL:
                continue
            count += 1
            scores = (
                cv2.matchTemplate(searched[rows], block, cv2.TM_CCOEFF_NORMED) for searched in (first, second)
            )
            self_scores, other_scores = (score.max(axis=0) for score in scores)
            self_scores[max(0, x - _BLOCK // 2) : x + _BLOCK // 2] = 0
            if other_scores.max() > max(_ALIKE, self_scores.max() + _BETTER):
                shifts.append(int(other_scores.argmax()) - x)
    if count < _BLOCKS or not shifts:
        return 0.0, 0.0
    consistent = np.abs(np.array(shifts) - np.median(shifts)) < size[0] / 12
    return float(consistent.sum() / count), float(np.percentile(np.abs(shifts), 90))
