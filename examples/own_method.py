"""Scores a force estimation method of your own against a recording's force sensor, with `bench`.

bench from-dataset out --out recordings
python examples/own_method.py recordings/000000
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import bench


class Spring:
    """Force as stiffness times the tissue's mean displacement, without direction."""

    def __init__(self, mm: float = 60.0) -> None:
        self.mm = mm
        """Length F/(E u) [mm]: force over Young's modulus and mean displacement."""

    def __call__(
        self, frame: bench.FrameMotion, scene: bench.MethodContext, picture: bool
    ) -> bench.ForceEstimate:
        """Force from flow (H, W, 2) px and its confidence (H, W), as in the bench's `Method`."""
        motion_mm = np.linalg.norm(frame.flow, axis=2) * scene.scale_mm_per_px
        young = scene.young_kpa or 1.0  # if unknown the bench scores only the curve's shape
        size = young * self.mm * np.average(motion_mm, weights=frame.confidence * scene.tissue + 1e-9)
        return bench.ForceEstimate(np.array([size, np.nan, np.nan]))  # a magnitude: no direction


def score_springs(recording: Path) -> bench.Result:
    """Scores of two springs on a recording."""
    methods = {"spring": Spring(60.0), "stiffer": Spring(120.0)}
    every_frame = bench.Settings(rate_hz=None)
    return bench.score(recording, methods=methods, settings=every_frame, baselines=False)


if __name__ == "__main__":
    for name, method in score_springs(Path(sys.argv[1])).methods.items():
        scores = method.scores
        print(f"{name}: r {scores['r']:.2f}, mean error {scores['mae_mn']:.2f} mN")
