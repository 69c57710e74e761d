"""How far recovered motion may be off: a standard deviation for each component, calibrated.

Across the view it is the flow's, which its confidence stands for. Along it what tells how far depth is off
(the flow's deviation, strain, what the eyes disagree on) enters as powers. The exponents were fitted to the
errors at contacts of rendered sequences and of four films by another renderer; `evidence.flow.stereo`
measures the z-scores on others.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.flow.stereo.depth_motion import Change

Map = NDArray[np.float32]

_AROUND = (5, 5)  # cells whose pictures a cell's depth rests on

_ALONG = (-1.42, 0.435, 0.226, 0.062)
"""For the change of disparity, in px: exponents of e, the flow's deviation [px], strain, misfit."""
_ACROSS = 1.15
"""For each component of the flow: its deviation's multiple."""


def deviations(change: Change, steepness: Map, spread: Map) -> tuple[Map, Map]:
    """Standard deviations by cell, each (h, w) px: of the change of disparity, and of the flow's components.

    Args:
        change: of the solver.
        steepness: (h, w), the flow's gradient [px/px].
        spread: (h, w) px, deviation of the flow's components that its confidence stands for.
    """
    misfit = np.clip(cv2.blur(change.misfit, (3, 3)), 0.2, 20)
    factors = np.full_like(spread, np.e), spread, steepness + 0.002, misfit
    along = np.prod([one**power for power, one in zip(_ALONG, factors, strict=True)], axis=0)
    # What the second eye doesn't see is known by the plate alone.
    along = np.maximum(along, 1 / inverse_posterior(change))
    return np.asarray(along, np.float32), np.asarray(_ACROSS * spread, np.float32)


def inverse_posterior(change: Change) -> Map:
    """One over the posterior deviation of a change by cell, (h, w) in 1/px."""
    precision = cv2.blur(change.precision, _AROUND, borderType=cv2.BORDER_REPLICATE) + 1e-3
    return np.asarray(np.sqrt(8 * np.sqrt(precision * change.stiffness)))
