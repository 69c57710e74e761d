"""From a network's answer to a force, for `learn predict` and the bench alike: the zero, and an unknown E."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from learn.inference.predict import ForceMap, Predictor
from synth.flow.stereo.track import Moved

UNKNOWN_YOUNG_KPA = 1.0
"""Tissue whose E nobody knows is answered for as if it were of this: forces are then right up to a factor."""


def assumed_young(young_kpa: float | None) -> float:
    """E to answer for [kPa]: the one known, else `UNKNOWN_YOUNG_KPA`; for every method, learnt or not."""
    return UNKNOWN_YOUNG_KPA if young_kpa is None else young_kpa


class ForceReader:
    """Reads the frames of one video.

    What the model says of the rest frame, where nothing has moved, is taken off the total force, as a
    sensor's tare is. Without a known E forces are those of tissue of 1 kPa: the model's own typical E would
    make the number depend on its training data.
    """

    def __init__(
        self,
        predictor: Predictor,
        tissue: NDArray[np.bool_],
        scale_mm_per_px: float,
        young_kpa: float | None,
    ) -> None:
        """`tissue`: (H, W) in the rest frame; `young_kpa`: of the tissue [kPa], None if unknown."""
        self._predictor, self._tissue = predictor, tissue
        self._scale, self._young_kpa = scale_mm_per_px, young_kpa
        self._zero: NDArray[np.float64] | None = None

    def read(
        self, flow: NDArray[np.float32], confidence: NDArray[np.float32] | None, moved: Moved | None = None
    ) -> tuple[NDArray[np.float64], ForceMap]:
        """Total force of a frame, and the map as the model says it, nothing taken off; errors as `Predictor`.

        `flow`: (H, W, 2) px; `confidence`: (H, W); `moved`: of two eyes. The force: (3,) mN on the tissue in
        camera axes; of a model without direction the size in x, the rest NaN.
        """
        said = self._say(flow, confidence, moved)
        if self._zero is None:
            sure = None if confidence is None else self._tissue.astype(np.float32)
            still = None if moved is None else Moved(0 * moved.motion, 0 * moved.deviation)
            self._zero = _total(self._say(np.zeros_like(flow), sure, still))
        force = _total(said) - self._zero
        if said.force_mn is None:
            force[0] = max(force[0], 0.0)
        return force, said

    def _say(
        self, flow: NDArray[np.float32], confidence: NDArray[np.float32] | None, moved: Moved | None
    ) -> ForceMap:
        said = self._predictor(flow, self._tissue, self._scale, self._young_kpa, confidence, moved)
        if said.young_known:
            return said
        part = assumed_young(None) / said.young_kpa
        head = None if said.head_mn is None else part * said.head_mn
        density = np.float32(part) * said.density
        return replace(said, density=density, head_mn=head, young_kpa=assumed_young(None))


def _total(said: ForceMap) -> NDArray[np.float64]:
    """(3,) mN, camera axes; a size alone goes into x."""
    if said.force_mn is not None:
        return said.force_mn
    return np.array([said.total_force_mn, np.nan, np.nan])
