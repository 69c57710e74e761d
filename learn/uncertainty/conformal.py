"""Split conformal prediction where the exchangeable unit is a sequence and the frames within it are not.

Hierarchical conformal prediction: Lee, Barber and Willett, "Distribution-free inference with hierarchical
data" (arXiv:2306.06342, 2023); the setting is that of Dunn, Wasserman and Ramdas, "Distribution-Free
Prediction Sets for Two-Layer Hierarchical Models" (JASA 2023). Frames pooled as if each were independent
cover too little whenever a sequence's errors go together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEVELS = (0.9, 0.68)
"""Shares of frames of a new unit that an interval is to hold."""


def least_units(level: float) -> int:
    """How many units are needed before any finite factor holds `level`: 9 for 90%, 3 for 68%."""
    return math.ceil(level / (1 - level) - 1e-9)


def quantile(scores: Sequence[Floats], level: float) -> float:
    """What the score of a frame of one more unit stays within, with a chance of `level` at least.

    Every unit weighs 1 / (K + 1), shared by its frames; the rest weighs on infinity, for the unit to come.

    Args:
        scores: of each of K exchangeable units, (n,) each, any n > 0.
        level: between 0 and 1.

    Returns:
        The quantile; infinity where K is under `least_units`.
    """
    return _weighted_quantile(scores, 1 / (len(scores) + 1), level)


def share_quantile(values: Sequence[Floats], level: float) -> float:
    """Plain quantile of what the units hold, (n,) each, every unit weighing alike: an estimate, no bound."""
    return _weighted_quantile(values, 1.0, level * len(values))


def _weighted_quantile(units: Sequence[Floats], weight: float, share: float) -> float:
    """Up to which value the weights, `weight` a unit, come to `share`; infinity if they don't."""
    values = np.concatenate(units)
    each = np.concatenate([np.full(len(unit), weight / len(unit)) for unit in units])
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(each[order]) >= share - 1e-9
    return float(values[order[np.argmax(reached)]]) if reached.any() else math.inf
