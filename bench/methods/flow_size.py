"""Baselines that use only the magnitude of the tissue's motion, to which scoring fits a gain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bench.methods.method_interface import ForceEstimate, FrameMotion, MethodContext
from synth.arrays import Floats

PEAK_PERCENTILE = 98.0  # for the largest displacement, without outliers of flow at edges; by hand


@dataclass(frozen=True)
class FlowSize:
    """A statistic of the flow's length over the tissue [mm], in place of a force.

    Masked tissue, where flow is filled in, counts: a mask in some frames only would change it more.
    """

    measure: Callable[[Floats], float]  # the statistic [mm] of at least one length, (P,) mm

    def __call__(self, frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        """See `Method`; NaN where no tissue is visible."""
        lengths = np.linalg.norm(frame.flow[scene.tissue].astype(np.float64), axis=1) * scene.scale_mm_per_px
        visible = bool((frame.confidence[scene.tissue] > 0).any())
        return ForceEstimate(np.array([self.measure(lengths) if visible else np.nan, np.nan, np.nan]))


def flow_sizes() -> dict[str, FlowSize]:
    """Mean and peak length of the flow, by their names in tables."""
    return {
        "mean |flow|": FlowSize(lambda lengths: float(lengths.mean())),
        "peak |flow|": FlowSize(lambda lengths: float(np.percentile(lengths, PEAK_PERCENTILE))),
    }
