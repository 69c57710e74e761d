"""Correction of the depth motion of stereo and its standard deviation, as in `synth.flow.correction`.

A thin plate that is soft enough for a dimple follows noise; a stiffer one flattens the dimple, by an eighth
at a contact. A network estimates the error from the lateral motion, the remaining residual and its precision.
It works on the cells of the solver, in mm, so that neither the size of pictures nor the baseline is learnt.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from synth.arrays import Map
from synth.flow import correction
from synth.flow.stereo.depth_motion import Change, Solver

WEIGHTS = Path(__file__).with_name("depth_correction.onnx")
_WINDOWS = 1, 3  # cells a side
_STEPS = [f"{part} over {side}" for side in _WINDOWS for part in ("step", "precision")]
FEATURES = (
    *("visible in both", "tissue", "motion x", "motion y", "motion away", *_STEPS),
    *("plate's deviation", "misfit", "flow's deviation", "strain"),
)
"""Input channels of the network, in the order of its weights."""
CHANNELS = len(FEATURES)
VECTORS = ((FEATURES.index("motion x"), FEATURES.index("motion y")),)  # as in `synth.flow.correction`
UNIT_MM = 0.1  # unit of the network's outputs
_MAX_STEP_MM = 0.5  # limit of a linearised step


def describe(
    change: Change, solver: Solver, flow: Map, visible: Map, spread: Map, px_per_mm: float, mm_per_px: float
) -> Map:
    """`FEATURES` (CHANNELS, h, w) float32 of a frame on the cells of the solver.

    `change` of `solver` is by the left camera's rectified `flow` (2, H, W) px; `visible`: (h, w) share of a
    cell that is unmasked tissue in the left picture; `spread`: (h, w) px, deviation of a flow component;
    `px_per_mm` as in `Solver.solve`; `mm_per_px`: size of a pixel at the tissue.
    """
    average, lateral = solver.average_cells, [mm_per_px * solver.average_cells(part) for part in flow]
    cell_change = average(change.px)
    planes = [average(change.visible), visible, *lateral, -cell_change / px_per_mm]
    residual_pull = change.pull - change.precision * cell_change
    for side in _WINDOWS:
        precision, pull = (
            cv2.blur(plane, (side, side), borderType=cv2.BORDER_REPLICATE)
            for plane in (change.precision, residual_pull)
        )
        step = -pull / (precision + 1) / px_per_mm
        planes += [_MAX_STEP_MM * np.tanh(step / _MAX_STEP_MM), -np.log(px_per_mm * np.sqrt(precision + 1))]
    misfit = np.clip(cv2.blur(change.misfit, (3, 3)), 0.1, 30)
    strain, plate = solver.steepness(flow) + 0.002, change.deviation / px_per_mm
    planes += [np.log(part) for part in (plate, misfit, mm_per_px * spread, strain)]
    return np.stack(planes).astype(np.float32)


def correct(features: Map) -> tuple[Map, Map]:
    """Correction of the depth motion and its deviation, (h, w) mm, for `FEATURES` (CHANNELS, h, w)."""
    height, width = features.shape[1:]
    output = correction.predict(WEIGHTS, features)[:, :height, :width]
    return UNIT_MM * output[0], UNIT_MM * np.exp(0.5 * output[1].clip(-8, 5))
