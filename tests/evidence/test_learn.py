"""Measurements of learning: coarser grids."""

import numpy as np
import pytest

from evidence.datasets import coarser
from learn.data.clips import Clip
from learn.data.grid import Grid

GRID = Grid(32)


def test_a_coarser_grid_preserves_force_and_motion(clips: list[Clip]) -> None:
    wide = coarser(clips[2], 2)
    fine = clips[2].density.sum((2, 3)) * GRID.pitch_mm**2
    np.testing.assert_allclose(wide.density.sum((2, 3)) * Grid(16).pitch_mm ** 2, fine, rtol=1e-4, atol=1e-6)
    largest = [np.abs(c.displacement["ideal"]).max() for c in (clips[2], wide)]
    assert largest[1] == pytest.approx(largest[0], rel=0.1)
