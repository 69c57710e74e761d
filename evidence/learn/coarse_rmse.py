"""A map's error over cells of one width, whatever grid it was said on: what makes grids comparable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from evidence.learn.labels import coarser
from learn.data.clips import Clip
from learn.inference.predict import Predictor, length

CELLS = 64
"""Cells along the edge of the grid that answers and truth are averaged onto."""


def wide_rmse(predictor: Predictor, clips: Sequence[Clip], source: str, cells: int = CELLS) -> list[float]:
    """RMSE [mN/mm²] of each clip's map over tissue cells of a grid of `cells` along its edge; answer and
    truth are averaged onto it.

    The predictor's own grid must have a multiple of that.
    """
    grid, out = predictor.card.settings.grid, []
    for clip in clips:
        mask = np.asarray(clip.mask)
        said = predictor.density(np.asarray(clip.displacement[source]), mask, clip.young_kpa) * mask
        both = (clip, replace(clip, density=said))
        true, answer = (coarser(c, grid, grid.size // cells) for c in both)
        gap = length(answer.density) - length(true.density) * np.float32(clip.young_kpa)
        out.append(float(np.sqrt(np.square(gap[:, true.mask > 0]).mean(dtype=np.float64))))
    return out
