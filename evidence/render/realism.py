"""Image statistics of renderings against a photograph, which is not stored."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from evidence import report, status
from evidence.render import picture_statistics
from evidence.render.case import case
from evidence.render.picture_statistics import Picture
from evidence.study import Study
from synth.errors import UserError
from synth.job.schema import Job

_SIDE, _STEP = 160, 40
OUTLINE = (
    "0.2,0.56 0.29,0.31 0.39,0.19 0.52,0.16 0.6,0.29 0.67,0.42 0.71,0.6 0.67,0.73 0.6,0.86 0.47,0.91"
    " 0.37,0.86 0.28,0.76"
)
"""Of the cortex in the photograph of the stored results."""


def measure(
    photo: Path,
    outline: str = OUTLINE,
    width_mm: float = 110.0,
    frames: int = 12,
    family: str = "healthy",
    seed: int = 11,
) -> dict[str, Any]:
    """Colour, spectrum, gradients and highlights of rendered frames against crops of a photograph.

    `outline`: polygon of the cortex in it, as shares "x,y x,y ..."; `width_mm`: width of the photograph in
    the field; `frames`: number of rendered sequences, one frame each.
    """
    crops, pixel = _rendered(frames, family, seed)
    photograph = scaled_photograph(photo, width_mm / pixel)
    inside = outlined(outline, photograph.shape[:2])
    reference = picture_statistics.tiles(photograph, inside, _SIDE, _STEP)
    pooled = picture_statistics.pool(reference)
    theirs, ours = picture_statistics.spread(reference, pooled), picture_statistics.spread(crops, pooled)
    rows = [
        {
            "statistic": name,
            "photograph": [round(v, 4) for v in theirs[name]],
            "rendered": [round(v, 4) for v in ours[name]],
            "median_within_spread": theirs[name][0] <= ours[name][1] <= theirs[name][2],
        }
        for name in theirs
    ]
    return {
        "data": status.data(photo),
        "family": family,
        "seed": seed,
        "crops": {"photograph": len(reference), "rendered": len(crops), "side_px": _SIDE},
        "photograph_width_mm_assumed": width_mm,
        "mm_per_px": pixel,
        "statistics": rows,
    }


def _rendered(frames: int, family: str, seed: int) -> tuple[list[Picture], float]:
    """Crops of the tissue in frames without an instrument, and the median mm of a pixel."""
    job = Job.model_validate({"seed": seed, "appearance": {"families": [family]}, "render": {"tool": False}})
    crops, pixels = [], []
    for index in range(frames):
        picture, inside, mm_per_px = bare_picture(job, index)
        crops += picture_statistics.tiles(picture, inside, _SIDE, _STEP)
        pixels.append(mm_per_px)
    return crops, float(np.median(pixels))


def bare_picture(job: Job, index: int) -> tuple[Picture, NDArray[np.bool_], float]:
    """First frame of a sequence, its tissue less a rim of 4 px, and its scale [mm per px]."""
    one = case(job, index)
    rest = one.renderer.rest
    inside = cv2.erode(rest.tissue.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    return one.renderer.render(one.state(), index).rgb, inside, rest.scale_mm_per_px


def outlined(outline: str, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Pixels (H, W) inside a polygon in shares of the image, "x,y x,y ..."."""
    corners = np.array([[float(v) for v in pair.split(",")] for pair in outline.split()])
    inside = np.zeros(shape, np.uint8)
    cv2.fillPoly(inside, [np.rint(corners * np.array(shape[::-1])).astype(np.int32)], 1)
    return inside > 0


def scaled_photograph(photo: Path, width_px: float) -> Picture:
    """The photograph (H, W, 3) sRGB, `width_px` wide."""
    image = cv2.imread(str(photo), cv2.IMREAD_COLOR)
    if image is None:
        raise UserError(f"{photo}: not an image that can be read")
    scale = width_px / image.shape[1]
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small[..., ::-1])


def page(found: Mapping[str, Any]) -> report.Page:
    """Statistics of renderings in units of the photograph's spread."""
    rows = []
    for one in found["statistics"]:
        (low, middle, high), rendered = one["photograph"], one["rendered"]
        a, b, c = ((value - middle) / max(high - low, 1e-12) for value in rendered)
        rows.append(report.Row(one["statistic"], b, (a, c)))
    unit = "quantiles of renderings less the photograph's median, over its spread"
    chart = report.Chart("Within half a unit: as crops of the photograph differ", unit, tuple(rows))
    within = sum(one["median_within_spread"] for one in found["statistics"])
    words = [f"**The medians of {within} of {len(rows)} statistics lie within the photograph's spread.**"]
    sections = [report.Section("", found["statistics"])]
    return report.Page("Renderings against a photograph", found, [chart], sections, words)


STUDY = Study(measure, "render/realism/realism.json", page, ("{photo}",))
