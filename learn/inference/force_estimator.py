"""A network's force estimates for the frames of a video: rest frame subtracted, unknown E, intervals."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from learn.data.clips import UNKNOWN_YOUNG_KPA
from learn.inference.grid_placement import GridPlacement, Point
from learn.inference.predict import ForceMap, Predictor, net_force
from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.intervals import Band, Prediction
from learn.uncertainty.out_of_distribution import describe_out_of_distribution
from synth.arguments import checked
from synth.arrays import Floats, Map, Mask
from synth.errors import UserError
from synth.flow.confidence import LOW_CONFIDENCE
from synth.flow.recording.frame_motion import FrameMotion
from synth.flow.stereo.stereo_track import Motion3D
from synth.job.types import MembraneState
from synth.plugins import check_answer


@checked
def predict_force(
    model: Predictor,
    flow: Iterable[Map],
    tissue: Mask,
    scale_mm_per_px: float,
    young_kpa: float | None = None,
    confidence: Iterable[Map] | None = None,
    membrane: MembraneState = "unknown",
) -> Floats:
    """Force of each frame of one video, (T, 3) mN on the tissue, camera axes; the rest frame's is subtracted.

    A model without direction returns the size in x, and NaN in y and z.

    Args:
        model: from `load_model`.
        flow: T times (H, W, 2) px, motion from the rest frame at the rest frame's pixels.
        tissue: (H, W), in the rest frame.
        scale_mm_per_px: of the picture.
        young_kpa: of the tissue; None: forces are those of tissue of 1 kPa.
        confidence: T times (H, W) in 0..1, for a model that uses it.
        membrane: state of the membrane (pia), for a model with that input.

    Raises:
        UserError: shapes that don't match, values that aren't finite, or a stereo model.
    """
    if len(size := np.shape(tissue)) != 2:
        raise UserError(f"tissue: expected an array (H, W), got {size}")
    mask = check_answer("predict_force", "tissue", tissue, size) != 0
    estimator = ForceEstimator(model, mask, scale_mm_per_px, young_kpa, membrane)
    full_confidence, forces = np.ones(size, np.float32), list[Floats]()
    pairs = (
        ((step, full_confidence) for step in flow) if confidence is None else zip_longest(flow, confidence)
    )
    for step, weight in pairs:
        if step is None or weight is None:
            raise UserError("confidence: has another number of frames than flow")
        step = check_answer("predict_force", "flow", step, (*size, 2))
        weight = check_answer("predict_force", "confidence", weight, size, (0.0, 1.0))
        forces.append(estimator.estimate(FrameMotion(step, weight)).force_mn)
    return np.array(forces).reshape(-1, 3)


@dataclass(frozen=True)
class FrameForce:
    """A model's estimate for one frame."""

    force_mn: Floats
    """(3,) total force on the tissue in camera axes [mN], the estimate at rest subtracted; of a model without
    direction the size in x, the others NaN."""
    map: ForceMap  # the network's prediction, nothing subtracted
    bands: dict[float, Band]  # intervals of the force by level, T = 1 [mN]; empty without intervals


class ForceEstimator:
    """Force estimates for the frames of one video.

    The prediction for no motion is subtracted from the total force, as a sensor's tare is. Without a known E
    forces are those of tissue of 1 kPa: the model's typical E would make them depend on its training data.
    """

    def __init__(
        self,
        predictor: Predictor,
        tissue: Mask,
        scale_mm_per_px: float,
        young_kpa: float | None,
        membrane: MembraneState = "unknown",
    ) -> None:
        """`tissue`: (H, W) in the rest frame; `young_kpa`: None if unknown."""
        self._predictor, self._tissue = predictor, tissue
        self._scale, self._young_kpa, self._membrane = scale_mm_per_px, young_kpa, membrane
        self._at_rest: dict[Point, ForceMap] = {}
        self.placement = GridPlacement(tissue, scale_mm_per_px, predictor.grid)
        self._tracked: list[Floats] = []  # (F,) `motion_features` of each tracked frame

    def estimate(self, frame: FrameMotion) -> FrameForce:
        """The force of a frame. Raises as `Predictor`."""
        place = self.placement.place(frame.flow, frame.confidence)
        force_map = self._predict(frame, place)
        if place not in self._at_rest:
            motion = frame.motion and Motion3D(0 * frame.motion.motion, 0 * frame.motion.deviation)
            rest_motion = FrameMotion(
                np.zeros_like(frame.flow), self._tissue.astype(np.float32), motion=motion
            )
            self._at_rest[place] = self._predict(rest_motion, place)
        # In a lost frame no pixel reaches the confidence of tracked tissue.
        if force_map.motion is not None and frame.confidence.max() >= LOW_CONFIDENCE:
            self._tracked.append(force_map.motion)
        density, at_rest = force_map.density[None], self._at_rest[place].density[None]
        force = net_force(density, at_rest, force_map.grid)[0]
        return FrameForce(force, force_map, self._bound(force, force_map))

    @property
    def notes(self) -> list[str]:
        """Warnings about the model and the grid's position, complete after the last frame."""
        ignored = self._membrane != "unknown" and not self._predictor.card.settings.arch.membrane
        notes = ["this network has no membrane input: --membrane is ignored"] if ignored else []
        if self.placement.fits:
            return notes
        extent_mm = self._predictor.grid.extent_mm
        note = f"the tissue is wider than the network's {extent_mm:g} mm: its grid lies on what moves most"
        note += f", and was moved {self.placement.moves} times" if self.placement.moves else ""
        return [*notes, note]

    @property
    def interval_notes(self) -> list[str]:
        """Warnings about the intervals, complete after the last frame."""
        intervals = self._predictor.card.intervals
        if intervals is None:
            return []
        ideal = ["intervals were fitted on true motion: for recovered motion they are too narrow"]
        notes = ideal if intervals.source in ("ideal", "motion-ideal") else []
        if self._tracked:
            motion = np.stack(self._tracked)
            notes = notes + describe_out_of_distribution(intervals.distribution, intervals.features, motion)
        return notes

    def _predict(self, frame: FrameMotion, place: Point) -> ForceMap:
        inputs = frame.flow, self._tissue, self._scale, self._young_kpa, frame.confidence, frame.motion
        force_map = self._predictor(*inputs, centre_px=place, membrane=self._membrane)
        if force_map.young_known:
            return force_map
        part = np.float32(UNKNOWN_YOUNG_KPA / force_map.young_kpa)
        return replace(force_map, density=part * force_map.density, young_kpa=UNKNOWN_YOUNG_KPA)

    def _bound(self, force: Floats, force_map: ForceMap) -> dict[float, Band]:
        """Intervals of a frame's force, as `FrameForce.bands`."""
        if force_map.motion is None:
            return {}
        intervals, young, motion = self._predictor.card.intervals, force_map.young_kpa, force_map.motion[None]
        assert intervals is not None, "only a model with intervals gives a map its motion"
        magnitude = force_map.magnitude[None] / np.float32(young)
        predicted = Prediction(motion, force[None] / young, magnitude, force_map.grid.pitch_mm)
        return {level: intervals.bound(predicted, level).times(young) for level in LEVELS}
