"""From a network's answer to a force, for `learn predict` and the bench alike: the zero, and an unknown E."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from learn.inference.predict import ForceMap, Predictor


@dataclass(frozen=True, eq=False)
class Reading:
    """One frame's force."""

    force_mn: NDArray[np.float64]
    """(3,) total force on the tissue in camera axes [mN]; a model without direction: size in x, rest NaN."""
    map: ForceMap
    """As the model says it, nothing taken off."""

    @property
    def size_mn(self) -> float:
        return float(np.sqrt(np.nansum(self.force_mn**2)))


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

    def read(self, flow: NDArray[np.float32], confidence: NDArray[np.float32] | None) -> Reading:
        """Force of a frame from its flow (H, W, 2) px and confidence (H, W); errors as `Predictor`."""
        said = self._say(flow, confidence)
        if self._zero is None:
            sure = None if confidence is None else self._tissue.astype(np.float32)
            self._zero = _total(self._say(np.zeros_like(flow), sure))
        force = _total(said) - self._zero
        if said.force_mn is None:
            force[0] = max(force[0], 0.0)
        return Reading(force, said)

    def _say(self, flow: NDArray[np.float32], confidence: NDArray[np.float32] | None) -> ForceMap:
        said = self._predictor(flow, self._tissue, self._scale, self._young_kpa, confidence)
        if said.young_known:
            return said
        head = None if said.head_mn is None else said.head_mn / said.young_kpa
        density = said.density / np.float32(said.young_kpa)
        return replace(said, density=density, head_mn=head, young_kpa=1.0)


def _total(said: ForceMap) -> NDArray[np.float64]:
    """(3,) mN, camera axes; a size alone goes into x."""
    if said.force_mn is not None:
        return said.force_mn
    return np.array([said.total_force_mn, np.nan, np.nan])
