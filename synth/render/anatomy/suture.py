"""Threads that hold the dura around an opening.

None of it is tissue or an acting instrument: it hides what is below it, in pictures and truth alike.
Sizes (mm), albedos (linear RGB) and absorptions were chosen by eye on an intra-operative photograph.
"""

from __future__ import annotations

import numpy as np

from synth.arrays import Array, Map
from synth.render.anatomy.layers import Rgb, step


class Suture:
    """A stitch's black thread."""

    albedo: Rgb = (0.025, 0.025, 0.035)
    half_mm: float = 0.075
    raised_mm: float = 0.08


def aside(angle: Array, stitch: Array | float) -> Array:
    """Signed angle (...) from a stitch, the shorter way [rad]."""
    return np.mod(angle - stitch + np.pi, 2 * np.pi) - np.pi


def threaded(across: Map, away: Map, colour: Map, bumps: Map) -> tuple[Map, Map]:
    """Colour (r, n, 3) and bumps mm with threads: two strands from each stitch, meeting far out.

    `across`, `away` (r, n) mm: signed distance from the nearest stitch along the edge, and beyond the edge.
    """
    # A loop, round where it pierces the dura, its strands together far out.
    apart = 0.42 * np.sqrt(np.clip((away - 0.9) / 0.7, 0, 1)) * np.clip(1 - (away - 1.0) / 12.0, 0, 1)
    line = np.where(away > 0.9, np.abs(np.abs(across) - apart), 9.0)
    threads = step((Suture.half_mm - line) / 0.06 + 0.2)
    colour = colour + threads[..., None] * (np.array(Suture.albedo, np.float32) - colour)
    return colour, bumps + np.float32(Suture.raised_mm) * threads
