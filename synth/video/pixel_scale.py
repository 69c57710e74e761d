"""Millimetres a pixel, stated or unknown: one rule for `learn predict`, `bench score` and `bench live`.

Force goes with the scale as it goes with E: of either unknown, a factor is. So of a picture of unknown scale
a width is taken, E is taken for unknown too, and answers are right up to one factor.
"""

from __future__ import annotations

import math
from typing import Literal

from synth.errors import UserError

StatedScale = float | Literal["unknown"]
"""mm a pixel."""

ASSUMED_WIDTH_MM = 32.0
"""Width that a picture of unknown scale is taken to have [mm]: about what a microscope shows of a cortex."""

UNKNOWN_NOTE = (
    f"scale unknown: answers are per pixel, on a picture taken to be {ASSUMED_WIDTH_MM:g} mm wide, "
    "and right up to a factor"
)


def read_scale(text: str | None) -> StatedScale | None:
    """What `--scale` says; None if it wasn't given. UserError if it is neither positive nor `unknown`."""
    if text is None:
        return None
    if text == "unknown":
        return "unknown"
    try:
        scale = float(text)
    except ValueError:
        scale = math.nan
    if not 0 < scale < math.inf:
        raise UserError(f"--scale {text}: give mm a pixel, or unknown")
    return scale


def pixel_mm(stated: StatedScale, width: int) -> float:
    """mm a pixel of a picture so wide [px]: as stated, or as taken."""
    return ASSUMED_WIDTH_MM / width if stated == "unknown" else stated
