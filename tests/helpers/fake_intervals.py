"""Intervals with constant half widths."""

import dataclasses
from pathlib import Path

import numpy as np

from learn.checkpoint import read_card, write_card
from learn.uncertainty.error_model import ErrorModel
from learn.uncertainty.features import ESTIMATE, motion_names
from learn.uncertainty.intervals import Intervals, Spread
from learn.uncertainty.out_of_distribution import MotionDistribution

FACTORS = {"0.9": 2.0, "0.68": 1.0}


def make(frame_limit: float = 1e6) -> Intervals:
    """Half widths of the 68% interval are, per unit stiffness, 5 of size and 3, 4 and 50 of x, y and z.

    `frame_limit`: distance, in logarithm of motion from 1 mm, beyond which a frame is out of distribution.
    """
    names = (*motion_names(False), *ESTIMATE)

    def spread(half: float, features: int) -> Spread:
        low, high = ((end,) * features for end in (-1e9, 1e9))
        scale = ErrorModel(float(np.log(half)), (0.0,) * features, low, high, 1e-9)
        return Spread(scale, dict(FACTORS))

    count = len(names) - len(ESTIMATE)
    precision = tuple(tuple(float(i == j == 0) for j in range(count)) for i in range(count))
    size, *axes = (spread(half, len(names)) for half in (5.0, 3.0, 4.0, 50.0))
    distribution = MotionDistribution((0.0,) * count, precision, frame_limit)
    return Intervals(names, 100.0, size, tuple(axes), distribution, "recovered", 19, 19)


def give(folder: Path, intervals: Intervals) -> Path:
    """Writes the intervals into the model's card; returns its folder."""
    write_card(folder, dataclasses.replace(read_card(folder), intervals=intervals))
    return folder
