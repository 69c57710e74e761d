"""The photograph with which renderings are compared, which is not stored, and pictures of bare cortex."""

from pathlib import Path

import cv2
import numpy as np

from evidence.render.case import case
from synth.arrays import Mask, Pixels
from synth.errors import UserError
from synth.job.schema import Job

OUTLINE = (
    "0.2,0.56 0.29,0.31 0.39,0.19 0.52,0.16 0.6,0.29 0.67,0.42 0.71,0.6 0.67,0.73 0.6,0.86 0.47,0.91"
    " 0.37,0.86 0.28,0.76"
)
"""Of the cortex in the photograph of the stored results."""


def corners(inside: Mask, side: int, step: int) -> list[tuple[int, int]]:
    """Upper left corners (x, y) of square crops of `side` px wholly inside a mask, every `step` px."""
    summed = cv2.integral(inside.astype(np.uint8))
    covered = summed[side:, side:] - summed[:-side, side:] - summed[side:, :-side] + summed[:-side, :-side]
    return [(int(x * step), int(y * step)) for y, x in np.argwhere(covered[::step, ::step] == side * side)]


def bare_picture(job: Job, index: int) -> tuple[Pixels, Mask, float]:
    """First frame of a sequence, its tissue less a rim of 4 px, and its scale [mm per px]."""
    one = case(job, index)
    rest = one.renderer.rest
    inside = cv2.erode(rest.tissue.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    return one.renderer.render(one.state(), index).rgb, inside, rest.scale_mm_per_px


def outlined(outline: str, shape: tuple[int, ...]) -> Mask:
    """Pixels (H, W) inside a polygon in shares of the image, "x,y x,y ..."."""
    corners = np.array([[float(v) for v in pair.split(",")] for pair in outline.split()])
    inside = np.zeros(shape, np.uint8)
    cv2.fillPoly(inside, [np.rint(corners * np.array(shape[::-1])).astype(np.int32)], 1)
    return inside > 0


def scaled_photograph(photo: Path, width_px: float) -> Pixels:
    """The photograph (H, W, 3) sRGB, `width_px` wide."""
    image = cv2.imread(str(photo), cv2.IMREAD_COLOR)
    if image is None:
        raise UserError(f"{photo}: not an image that can be read")
    scale = width_px / image.shape[1]
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small[..., ::-1])
