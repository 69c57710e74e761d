"""Scores a method of one's own as the bench scores networks: against a recording's force sensor.

bench from-dataset out --out recordings
python examples/own_method.py recordings/000000
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import bench


class Spring:
    """Force as stiffness times the mean displacement of the tissue: blind to direction, and to depth."""

    def __init__(self, mm: float = 60.0) -> None:
        self.mm = mm
        """Mean displacement of 1 mm is what E times this much squared, in mN, would do."""

    def __call__(
        self, flow: np.ndarray, confidence: np.ndarray, scene: bench.MethodContext, picture: bool
    ) -> bench.ForceEstimate:
        """Force from flow (H, W, 2) px and its confidence (H, W), the bench's `Method`."""
        moved_mm = np.linalg.norm(flow, axis=2) * scene.scale_mm_per_px
        young = scene.young_kpa or 1.0  # unknown: the bench then scores shapes only
        size = young * self.mm * np.average(moved_mm, weights=confidence * scene.tissue + 1e-9)
        return bench.ForceEstimate(np.array([size, np.nan, np.nan]))  # a magnitude: no direction


def score_springs(recording: Path) -> bench.Result:
    """The recording's scores under two springs."""
    methods = {"spring": Spring(60.0), "stiffer": Spring(120.0)}
    every_frame = bench.Settings(rate_hz=None)
    return bench.score(recording, methods=methods, settings=every_frame, baselines=False)


if __name__ == "__main__":
    for name, method in score_springs(Path(sys.argv[1])).methods.items():
        scores = method.scores
        print(f"{name}: r {scores['r']:.2f}, mean error {scores['mae_mn']:.2f} mN")
