"""Hierarchical split conformal prediction: units (brains) are exchangeable, the frames within them are not.

Lee, Barber and Willett, "Distribution-free inference with hierarchical data" (arXiv:2306.06342, 2023), in the
setting of Dunn, Wasserman and Ramdas, "Distribution-Free Prediction Sets for Two-Layer Hierarchical Models"
(JASA 2023). Frames pooled as if independent would cover too little, as errors within a sequence correlate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from synth.arrays import Floats

LEVELS = (0.9, 0.68)  # coverage of a new unit's frames


def least_units(level: float) -> int:
    """Number of units needed for a finite quantile at `level`: 9 for 90%, 3 for 68%."""
    return math.ceil(level / (1 - level) - 1e-9)


def quantile(scores: Sequence[Floats], level: float) -> float:
    """Bound on the score of a frame of a new unit that holds with a probability of at least `level`.

    `scores`: (n,) of each of K exchangeable units, any n > 0. Every unit weighs 1 / (K + 1), shared by its
    frames; the rest is at infinity, for the new unit, as is the quantile if K is under `least_units`.
    """
    return weighted_quantile(scores, 1 / (len(scores) + 1), level)


def weighted_quantile(units: Sequence[Floats], weight: float, share: float) -> float:
    """Value at which the summed weights, `weight` per unit (n,), reach `share`; infinity if they don't."""
    values = np.concatenate(units)
    weights = np.concatenate([np.full(len(unit), weight / len(unit)) for unit in units])
    order = np.argsort(values, kind="stable")
    is_reached = np.cumsum(weights[order]) >= share - 1e-9
    return float(values[order[np.argmax(is_reached)]]) if is_reached.any() else math.inf
