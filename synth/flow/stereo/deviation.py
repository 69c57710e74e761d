"""How far recovered motion may be off: a standard deviation for each component, calibrated.

From the posterior of the depth solver: with precision a of the data and stiffness b of a thin plate, both by
cell, the variance is 1 / (8 sqrt(a b)) (the plate's Green's function at 0). What else tells how far a motion
is off (strain, what the eyes disagree on, the flow's confidence with its way back, how far it went)
enters as powers, whose exponents were fitted to the errors on rendered sequences (`evidence.flow.stereo`
measures the z-scores on others).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.flow.stereo.depth_motion import Change

Map = NDArray[np.float32]

_AROUND = (5, 5)  # cells whose pictures a cell's depth rests on

# Exponents of 1 (e), posterior deviation [px], strain, misfit, doubt, way [px].
_ALONG = (0.663, 1.039, -0.023, 0.328, 0.09, 0.029)
"""For the change of disparity, in px."""
_ACROSS = (0.709, 1.137, -0.505, 0.396, 0.325, 0.37)
"""For each component of the flow, in px."""


def deviations(change: Change, steepness: Map, doubt: Map, way: Map) -> tuple[Map, Map]:
    """Standard deviations by cell, each (h, w) px: of the change of disparity, and of the flow's components.

    Args:
        change: of the solver.
        steepness: (h, w), the flow's gradient [px/px].
        doubt: (h, w) in 0..1, one less the flow's confidence.
        way: (h, w) px, length of the flow.
    """
    logarithms = np.log(
        np.stack(
            [
                np.full(doubt.shape, np.e),
                1 / inverse_posterior(change),
                steepness + 0.002,
                np.clip(cv2.blur(change.misfit, (3, 3)), 0.2, 20),
                np.clip(doubt, 0, 1) + 0.05,
                way + 0.1,
            ]
        ).astype(np.float64)
    )
    along, across = (np.exp(np.tensordot(powers, logarithms, 1)) for powers in (_ALONG, _ACROSS))
    return along.astype(np.float32), across.astype(np.float32)


def inverse_posterior(change: Change) -> Map:
    """One over the posterior deviation of a change by cell, (h, w) in 1/px."""
    precision = cv2.blur(change.precision, _AROUND, borderType=cv2.BORDER_REPLICATE) + 1e-3
    return np.asarray(np.sqrt(8 * np.sqrt(precision * change.stiffness)))
