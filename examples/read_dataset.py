"""Reads a dataset: applied force, motion of the tissue, and error of the recovered flow.

python examples/read_dataset.py out
"""

from __future__ import annotations

import sys

import numpy as np

import synth


def describe(sequence: synth.Sequence) -> dict[str, float]:
    """Five numbers of a sequence."""
    force = np.linalg.norm(sequence["force"][:], axis=1)  # (T,) mN
    t = int(force.argmax())
    # Traction integrated over the tissue area of each pixel is the force.
    traction, area = sequence["traction"][t], sequence["area"][:]  # (H, W, 3) kPa, (H, W) mm2
    labelled = np.linalg.norm(np.einsum("hwk,hw->k", traction, area))  # 1 kPa mm2 = 1 mN
    flow, visible = sequence["flow"][t], sequence["visible"][t]  # (H, W, 2) px, (H, W)
    numbers = {
        "young_kpa": float(sequence.attrs["young_kpa"]),
        "peak_force_mn": float(force[t]),
        "labelled_force_mn": float(labelled),
        "largest_motion_px": float(np.linalg.norm(flow, axis=2).max()),
    }
    if "flow_recovered" in sequence:
        error = np.linalg.norm(sequence["flow_recovered"][t] - flow, axis=2)
        numbers["median_flow_error_px"] = float(np.median(error[visible]))
    return numbers


if __name__ == "__main__":
    for sequence in synth.Dataset(sys.argv[1]):
        print(sequence.index, {name: round(value, 3) for name, value in describe(sequence).items()})
