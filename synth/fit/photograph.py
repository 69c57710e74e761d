"""A photograph of cortex at the scale that is fitted at, with what of it can be measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from synth.errors import UserError
from synth.fit.compression import Compression
from synth.fit.region import find_cortex
from synth.fit.statistics import Mask, Picture, View
from synth.job.schema import Render
from synth.system import foreign_file, foreign_picture

_SMALLEST_PX = 160
_LEAST_MM2 = 60.0  # of cortex: less holds no web of vessels


@dataclass(frozen=True)
class Photograph:
    """What a fit is made to."""

    view: View
    """The part that holds cortex."""
    compression: Compression


def usual_mm_per_px() -> float:
    """Scale of a default job's pictures at the craniotomy."""
    usual = Render()
    return sum(usual.field_mm) / 2 / usual.size[0]


def read_photograph(path: Path, width_mm: float, mask: Path | None) -> Photograph:
    """The photograph at the scale of a job's pictures, or at its own where that is coarser.

    Args:
        path: a picture file.
        width_mm: what its width spans at the cortex.
        mask: a picture of the same size, white where there is cortex to be measured; found if not given.

    Raises:
        UserError: it is no picture, too small, or shows too little cortex.
    """
    rgb = _picture(path)
    own = width_mm / rgb.shape[1]
    if min(rgb.shape[:2]) < _SMALLEST_PX:
        raise UserError(
            f"{path}: {rgb.shape[1]} x {rgb.shape[0]} pixels; at least {_SMALLEST_PX} each way are needed"
        )
    usable = find_cortex(rgb, own) if mask is None else _mask(mask, rgb)
    finer = max(1.0, usual_mm_per_px() / own)
    if finer > 1.02:
        rgb = np.asarray(
            cv2.resize(rgb, None, fx=1 / finer, fy=1 / finer, interpolation=cv2.INTER_AREA), np.uint8
        )
        small = cv2.resize(usable.astype(np.float32), rgb.shape[1::-1], interpolation=cv2.INTER_AREA)
        usable = np.asarray(small > 0.99)
    else:
        finer = 1.0
    scale = own * finer
    area = float(usable.sum()) * scale**2
    if area < _LEAST_MM2:
        advice = "mark it with --mask" if mask is None else "the mask leaves too little"
        raise UserError(
            f"{path}: {area:.0f} mm2 of cortex in a width of {width_mm:g} mm, {_LEAST_MM2:g} are needed; "
            f"{advice}, or say with --width-mm what the picture spans"
        )
    data = foreign_file.read_bytes(path, foreign_file.LARGEST_PICTURE)
    return Photograph(_cut(View.whole(rgb, usable, scale)), Compression.of_file(data, finer))


def _picture(path: Path) -> Picture:
    """(H, W, 3) sRGB."""
    return np.ascontiguousarray(np.asarray(foreign_picture.read_picture(path), np.uint8)[..., ::-1])


def _mask(path: Path, rgb: Picture) -> Mask:
    drawn = np.asarray(foreign_picture.read_picture(path, cv2.IMREAD_GRAYSCALE))
    if drawn.shape != rgb.shape[:2]:
        raise UserError(
            f"{path}: is {drawn.shape[1]} x {drawn.shape[0]} pixels, "
            f"the photograph {rgb.shape[1]} x {rgb.shape[0]}"
        )
    return np.asarray(drawn > 127)


def _cut(view: View) -> View:
    """The view without what lies outside the cortex's box."""
    rows, columns = (np.flatnonzero(view.usable.any(axis=axis)) for axis in (1, 0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return View(view.rgb[box].copy(), view.usable[box].copy(), view.mm_per_px, view.corner2[box].copy())
