"""Millimetres per pixel, given or unknown: one rule for `learn predict`, `bench score` and `bench live`.

Force is proportional to a power of the scale and to E. For an unknown scale a width of the picture is assumed
and E is treated as unknown too: estimates are right up to one factor.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Literal

from synth.errors import UserError

StatedScale = float | Literal["unknown"]  # mm per pixel

ASSUMED_WIDTH_MM = 32.0  # of a picture of unknown scale: a typical field of view of a microscope on cortex

_ASSUMED = f"the picture is assumed to be {ASSUMED_WIDTH_MM:g} mm wide"
UNKNOWN_NOTE = f"scale unknown: {_ASSUMED}; estimates are right up to a factor"


def read_scale(text: str | None) -> StatedScale | None:
    """Parses `--scale`; None if it is not given. UserError if it is neither positive nor `unknown`."""
    if text is None or text == "unknown":
        return None if text is None else "unknown"
    with suppress(ValueError):
        if 0 < float(text) < math.inf:
            return float(text)
    raise UserError(f"--scale {text}: give mm per pixel, or unknown")


def pixel_mm(stated: StatedScale, width: int) -> float:
    """Scale [mm/px] of a picture of that width [px]: as stated, or as assumed."""
    return ASSUMED_WIDTH_MM / width if stated == "unknown" else stated
