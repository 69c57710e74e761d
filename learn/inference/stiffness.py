"""Stiffness from one press: what video can't know, from a moment in which the force is known.

The network's answer per unit stiffness times E is the force, so one press with a known force (a weight, a
sensor on the tool) gives E for the rest of the recording.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from learn.inference.predict import Predictor, total_force
from synth.errors import UserError


def stiffness(
    predictor: Predictor,
    displacement: NDArray[np.float32],
    mask: NDArray[np.float32],
    force_mn: NDArray[np.float64],
    confidence: NDArray[np.float32] | None = None,
) -> float:
    """Young's modulus [kPa] that makes the answer to a press fit its force best, in the least squares.

    `displacement`: (T, 2, N, N) mm on the model's grid, of a model of two eyes (T, 3, N, N); `mask`: (N, N);
    `force_mn`: (T,) size of the known force; `confidence`: as `Predictor.density`. Raises UserError if the
    lengths differ, or if there is no force or no answer to fit.
    """
    if len(force_mn) != len(displacement):
        raise UserError(f"calibration press: {len(force_mn)} forces for {len(displacement)} frames")
    young = predictor.card.typical_young_kpa
    said = _sizes(predictor, displacement, mask, young, confidence)
    fit = float(said @ force_mn), float(said @ said)
    if not (np.isfinite(fit).all() and min(fit) > 0):
        raise UserError("calibration press: no force was given, or the model sees none in the motion")
    return young * fit[0] / fit[1]


def _sizes(
    predictor: Predictor,
    displacement: NDArray[np.float32],
    mask: NDArray[np.float32],
    young: float,
    confidence: NDArray[np.float32] | None,
) -> NDArray[np.float64]:
    """(T,) size of the force as `ForceReader` gives it: what is said of the rest frame is taken off [mN]."""
    said = predictor.density(displacement, mask, young, confidence)
    still = None if confidence is None else np.broadcast_to(mask, (1, *confidence.shape[1:]))
    zero = predictor.density(np.zeros_like(displacement[:1]), mask, young, still)
    kind, grid = predictor.card.settings.target, predictor.grid
    if said.shape[1] == 3:
        return total_force(said - zero, kind, grid)
    return np.maximum(total_force(said, kind, grid) - total_force(zero, kind, grid), 0.0)
