"""How much the tissue moves, and nothing else: the baselines that any method has to beat.

A method of force that follows the sensor no better than the mean length of the flow has learnt nothing from
where the tissue moves. Lengths are no forces: whoever scores them finds the one gain between the two.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bench.methods.protocol import Field, ForceEstimate, MethodContext

PEAK_PERCENTILE = 98.0
"""The largest displacement, without outliers of flow at edges; by hand."""


class FlowSize:
    """One number of the flow's length over the tissue [mm], in place of a force.

    Over all of it, though what is masked is but smoothly filled in: a mask that takes a part of what moves,
    and in some frames only, would change the number more than that does.
    """

    def __init__(self, measure: Callable[[NDArray[np.float64]], float]) -> None:
        """`measure`: lengths (P,) mm, at least one, to a number [mm]."""
        self._measure = measure

    def __call__(self, flow: Field, confidence: Field, scene: MethodContext, picture: bool) -> ForceEstimate:
        """See `Method`; NaN where nothing of the tissue is seen."""
        lengths = np.linalg.norm(flow[scene.tissue].astype(np.float64), axis=1) * scene.scale_mm_per_px
        seen = bool((confidence[scene.tissue] > 0).any())
        return ForceEstimate(np.array([self._measure(lengths) if seen else np.nan, np.nan, np.nan]))


def flow_sizes() -> dict[str, FlowSize]:
    """Mean and peak length of the flow, by the names they have in every table."""
    return {
        "mean |flow|": FlowSize(lambda lengths: float(lengths.mean())),
        "peak |flow|": FlowSize(lambda lengths: float(np.percentile(lengths, PEAK_PERCENTILE))),
    }
