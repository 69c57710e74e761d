"""Trained models as methods."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.special import ndtri

from bench.methods.force_mixture import ForceMixture
from bench.methods.method_interface import ForceEstimate, FrameMotion, MethodContext
from learn import Predictor, load_model
from learn.inference.force_estimator import ForceEstimator
from learn.inference.shipped_networks import find_name
from learn.uncertainty.intervals import LEVEL
from learn.uncertainty.out_of_distribution import OUT_OF_DISTRIBUTION


class Model:
    """A model of `learn train`. Without a known E its forces are those of tissue of 1 kPa."""

    def __init__(self, model: Path | Predictor) -> None:
        """`model`: itself, or its folder."""
        self.predictor: Predictor = load_model(model) if isinstance(model, Path) else model
        self._estimator: tuple[MethodContext, ForceEstimator] | None = None

    @property
    def identity(self) -> str:
        """Hash of the weights and gain of the force: equal for networks with equal estimates."""
        card = self.predictor.card
        return f"{card.weights_hash} x {card.force_gain:g}"

    @property
    def origin(self) -> str:
        """Where the model comes from, in words."""
        card = self.predictor.card
        name = find_name(card)
        return f"{name}, pretrained" if name else f"trained on {len(card.split.get('fit', []))} sequences"

    def describe(self) -> dict[str, object]:
        """The model's properties, for the report."""
        card = self.predictor.card
        return {**card.settings.model_dump(mode="json"), "force_gain": card.force_gain}

    @property
    def notes(self) -> list[str]:
        """Notes on the estimates of the last recording."""
        return [note for note in self._all_notes if not note.startswith(OUT_OF_DISTRIBUTION)]

    @property
    def doubt(self) -> list[str]:
        """Notes of `ModelCard.doubt` on the last recording."""
        return [] if self._estimator is None else self.predictor.card.doubt(self._estimator[0].recovered_by)

    @property
    def warnings(self) -> list[str]:
        """Reasons to doubt these estimates."""
        return [note for note in self._all_notes if note.startswith(OUT_OF_DISTRIBUTION)]

    @property
    def _all_notes(self) -> list[str]:
        return [] if self._estimator is None else self._estimator[1].notes + self._estimator[1].interval_notes

    is_elastic = True  # see `Method`

    def __call__(self, frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        """See `Method`; a monocular network uses the flow only."""
        if self._estimator is None or self._estimator[0] is not scene:
            constants = scene.tissue, scene.scale_mm_per_px, scene.young_kpa, scene.membrane
            self._estimator = scene, ForceEstimator(self.predictor, *constants)
        force = self._estimator[1].estimate(frame)
        estimate = ForceEstimate(force.force_mn, force.map.to_image() if picture else None)
        if not force.bands:
            return estimate
        band = force.bands[LEVEL]
        mixture = None
        if np.isfinite(force.force_mn).all():
            deviation = (band.axes_high[0] - band.axes_low[0]) / (2 * ndtri(0.5 + LEVEL / 2))
            mixture = ForceMixture(np.ones(1), force.force_mn[None], np.diag(deviation**2)[None])
        return replace(estimate, low_mn=float(band.low[0]), high_mn=float(band.high[0]), likely=mixture)
