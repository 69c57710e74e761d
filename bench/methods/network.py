"""Trained models behind the bench's protocol of methods."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.tracking.tracking import Answer, Scene

if TYPE_CHECKING:
    from learn.inference.predict import Predictor


class Model:
    """A model folder of `learn train`. Without a known E it answers for tissue of 1 kPa."""

    def __init__(self, folder: Path, quick: bool = False) -> None:
        """Loads the network; UserError if it can't be read.

        Args:
            folder: of the model.
            quick: spend half a second on a graph that takes a third less a frame.
        """
        from learn.inference.predict import load_predictor

        self.predictor: Predictor = load_predictor(folder, quick=quick)
        self._rest: tuple[Scene, NDArray[np.float64]] | None = None

    def described(self) -> dict[str, object]:
        """What the model is, for the report."""
        settings = self.predictor.card.settings
        return {
            "preset_size": settings.size,
            "extent_mm": settings.extent_mm,
            "width": settings.arch.width,
            "stem": settings.arch.stem,
            "input": settings.input,
            "target": settings.target,
        }

    def __call__(
        self, flow: NDArray[np.float32], confidence: NDArray[np.float32], scene: Scene, picture: bool
    ) -> Answer:
        """See `Method`. What it says of the rest frame, where nothing has moved, is taken off: a tare."""
        said, density = self._say(flow, confidence, scene, picture)
        if self._rest is None or self._rest[0] is not scene:
            still = np.zeros_like(flow), scene.tissue.astype(np.float32)
            self._rest = scene, self._say(*still, scene, False)[0]
        force = said - self._rest[1]
        if np.isnan(force[1:]).all():
            force[0] = max(force[0], 0.0)
        return Answer(force, density)

    def _say(
        self, flow: NDArray[np.float32], confidence: NDArray[np.float32], scene: Scene, picture: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float32] | None]:
        said = self.predictor(flow, scene.tissue, scene.scale_mm_per_px, scene.young_kpa, confidence)
        # The model's own typical E would make the number depend on its training data.
        per_kpa = 1.0 if scene.young_kpa is not None else 1.0 / said.young_kpa
        force = said.force_mn
        if force is None:
            force = np.array([said.total_force_mn, np.nan, np.nan])
        density = (per_kpa * said.to_image()).astype(np.float32) if picture else None
        return np.asarray(per_kpa * force, np.float64), density
