"""What the depth solver misses, and how far off it may be: the flow's correction, for the second eye.

A thin plate that is soft enough for a dimple follows noise; one that is stiff enough for noise flattens the
dimple, by an eighth where a tool touches. Which of both it did can be read from the motion across the view,
from what the pictures would still have, and from how sharply they know it; rendered truth teaches it. On the
solver's cells, in mm, so that neither size of picture nor baseline is learnt.

`evidence.flow.correction_training` makes the weights; they lie beside this file with a card.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.flow import correction
from synth.flow.stereo.depth_motion import Change, Map, Solver

WEIGHTS = Path(__file__).with_name("depth_correction.pt")
_WINDOWS = 1, 3  # cells a side
_STEPS = [f"{part} over {side}" for side in _WINDOWS for part in ("step", "precision")]
FEATURES = (
    *("visible in both", "tissue", "motion x", "motion y", "motion away", *_STEPS),
    *("plate's deviation", "misfit", "flow's deviation", "strain"),
)
"""Channels that the network takes, in the order that its weights are bound to."""
CHANNELS = len(FEATURES)
VECTORS = ((FEATURES.index("motion x"), FEATURES.index("motion y")),)
"""Channels that are x and y of a vector, as in `synth.flow.correction`."""
UNIT_MM = 0.1
"""Of what the network says."""
_FARTHEST_MM = 0.5  # no step of a linear equation is believed beyond


def describe(
    change: Change, solver: Solver, flow: Map, seen: Map, spread: Map, px_per_mm: float, mm_per_px: float
) -> NDArray[np.float32]:
    """The `FEATURES` of a frame: (CHANNELS, h, w) float32 on the solver's cells.

    Args:
        change: of the solver.
        solver: that found it.
        flow: (2, H, W) px, the left eye's, rectified.
        seen: (h, w) share of a cell that is unmasked tissue in the left eye.
        spread: (h, w) px, deviation of the flow's components.
        px_per_mm: change of disparity of a point that moves 1 mm away (its size).
        mm_per_px: across the view.
    """
    coarse, across = solver.coarse, [mm_per_px * solver.coarse(part) for part in flow]
    here = coarse(change.px)
    rows = [coarse(change.visible), seen, *across, -here / px_per_mm]
    left = change.pull - change.precision * here
    for side in _WINDOWS:
        precision, pull = (
            cv2.blur(a, (side, side), borderType=cv2.BORDER_REPLICATE) for a in (change.precision, left)
        )
        step = -pull / (precision + 1) / px_per_mm
        rows += [_FARTHEST_MM * np.tanh(step / _FARTHEST_MM), -np.log(px_per_mm * np.sqrt(precision + 1))]
    misfit = np.clip(cv2.blur(change.misfit, (3, 3)), 0.1, 30)
    strain, plate = solver.steepness(flow) + 0.002, change.deviation / px_per_mm
    rows += [np.log(part) for part in (plate, misfit, mm_per_px * spread, strain)]
    return np.stack(rows).astype(np.float32)


def correct(features: NDArray[np.float32]) -> tuple[Map, Map]:
    """Depth motion to be added and its standard deviation, both (h, w) mm. features: see `describe`.

    Raises:
        UserError: the weights aren't there.
    """
    height, width = features.shape[1:]
    found = correction.answer(correction.load(WEIGHTS, CHANNELS, 1), features)[:, :height, :width]
    return UNIT_MM * found[0], UNIT_MM * np.exp(0.5 * found[1].clip(-8, 5))
