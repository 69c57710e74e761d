"""From a network's answer to a force, for `learn predict` and the bench alike: the zero, and an unknown E."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from learn.data.grid import Grid
from learn.inference.placing import Placing, Point, share_at_border
from learn.inference.predict import ForceMap, Predictor, total_force
from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.features import is_moving
from learn.uncertainty.intervals import Band, Intervals, Prediction
from synth.flow.stereo.track import Moved

_MUCH_AT_BORDER = 0.1  # share of the force; what is spread evenly has a quarter there
_MANY_UNSEEN = 0.05  # share of the moving frames; of held-out ones it is a hundredth

UNKNOWN_YOUNG_KPA = 1.0
"""Tissue whose E nobody knows is answered for as if it were of this: forces are then right up to a factor."""


def assumed_young(young_kpa: float | None) -> float:
    """E to answer for [kPa]: the one known, else `UNKNOWN_YOUNG_KPA`; for every method, learnt or not."""
    return UNKNOWN_YOUNG_KPA if young_kpa is None else young_kpa


def predict_force(
    model: Predictor,
    flow: Iterable[NDArray[np.float32]],
    tissue: NDArray[np.bool_],
    scale_mm_per_px: float,
    young_kpa: float | None = None,
    confidence: Iterable[NDArray[np.float32]] | None = None,
) -> NDArray[np.float64]:
    """The force curve of one film: (T, 3) mN on the tissue, camera axes; what the rest frame says taken off.

    Of a model without direction the size is in x and the rest NaN.

    Args:
        model: of `load_model`.
        flow: T times (H, W, 2) px, motion from the rest frame at the rest frame's pixels.
        tissue: (H, W), in the rest frame.
        scale_mm_per_px: of the picture.
        young_kpa: of the tissue; None: forces are those of tissue of 1 kPa.
        confidence: T times (H, W) in 0..1, for a model that reads it.

    Raises:
        UserError: shapes that don't fit, values that aren't finite, or a model of two eyes.
    """
    reader = ForceReader(model, np.asarray(tissue, bool), scale_mm_per_px, young_kpa)
    pairs = ((one, None) for one in flow) if confidence is None else zip(flow, confidence, strict=True)
    return np.array([reader.read(one, sure)[0] for one, sure in pairs]).reshape(-1, 3)


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
        self._zero: dict[Point, NDArray[np.float64]] = {}
        self.placing = Placing(tissue, scale_mm_per_px, predictor.grid)
        """Where the network's grid lies."""
        self._at_border = self._in_all = 0.0
        self._bounded, self._far = False, list[float]()

    def read(
        self, flow: NDArray[np.float32], confidence: NDArray[np.float32] | None, moved: Moved | None = None
    ) -> tuple[NDArray[np.float64], ForceMap]:
        """Total force of a frame, and the map as the model says it, nothing taken off; errors as `Predictor`.

        `flow`: (H, W, 2) px; `confidence`: (H, W); `moved`: of two eyes. The force: (3,) mN on the tissue in
        camera axes; of a model without direction the size in x, the rest NaN.
        """
        place = self.placing.place(flow, confidence)
        said = self._say(flow, confidence, moved, place)
        if place not in self._zero:
            sure = None if confidence is None else self._tissue.astype(np.float32)
            still = None if moved is None else Moved(0 * moved.motion, 0 * moved.deviation)
            self._zero[place] = _total(self._say(np.zeros_like(flow), sure, still, place))
        force = _total(said) - self._zero[place]
        share = share_at_border(said.magnitude, said.view.mask)
        if not self.placing.fits and math.isfinite(share):
            size = float(np.sqrt(np.nansum(force**2)))
            self._at_border, self._in_all = self._at_border + share * size, self._in_all + size
        if said.force_mn is None:
            force[0] = max(force[0], 0.0)
        return force, said

    def bound(
        self, force: NDArray[np.float64], said: ForceMap, counted: bool = True
    ) -> dict[float, Band] | None:
        """By level, the intervals of a frame's force as `read` gave it, T = 1 [mN]; of the force of tissue of
        1 kPa where E is unknown. None of a model without intervals.

        What is counted here is what `notes` say of an unseen world.
        """
        if said.motion is None:
            return None
        found, one = self._intervals(), as_prediction(force, said)
        self._bounded = True
        if counted and is_moving(one.motion)[0]:
            self._far.append(self.distance(said))
        return {level: found.bound(one, level).times(said.young_kpa) for level in LEVELS}

    def distance(self, said: ForceMap) -> float:
        """Of a frame from what was fitted, over what 99% of held-out frames stay under.

        NaN where nothing moved, and of a model without intervals.
        """
        if said.motion is None or not is_moving(said.motion[None])[0]:
            return math.nan
        world = self._intervals().world
        return float(world.distance(said.motion[None])[0] / world.usual)

    @property
    def notes(self) -> list[str]:
        """What its user should know, once the frames are read: of where the grid lay, and of intervals."""
        return self._notes_of_place() + self._notes_of_intervals()

    def _intervals(self) -> Intervals:
        found = self._predictor.card.intervals
        assert found is not None, "a map has its motion from a model with intervals only"
        return found

    def _notes_of_intervals(self) -> list[str]:
        if not self._bounded:
            return []
        notes, found = [], self._intervals()
        if found.source in ("ideal", "motion-ideal"):
            notes.append("intervals are of true motion: of recovered motion they are too narrow")
        return notes + describe_unseen(np.array(self._far))

    def _notes_of_place(self) -> list[str]:
        if self.placing.fits:
            return []
        wide = self._predictor.grid.extent_mm
        said = f"the tissue is wider than the network's {wide:g} mm: it looks at what moves most"
        said += f", and was moved there {self.placing.moves} times" if self.placing.moves else ""
        share = self._at_border / self._in_all if self._in_all > 0 else 0.0
        if share > _MUCH_AT_BORDER:
            said += f"; {100 * share:.0f}% of the force lies at the border of that, what is beyond is lost"
        return [said]

    def _say(
        self,
        flow: NDArray[np.float32],
        confidence: NDArray[np.float32] | None,
        moved: Moved | None,
        place: Point,
    ) -> ForceMap:
        said = self._predictor(
            flow, self._tissue, self._scale, self._young_kpa, confidence, moved, centre_px=place
        )
        if said.young_known:
            return said
        part = assumed_young(None) / said.young_kpa
        return replace(said, density=np.float32(part) * said.density, young_kpa=assumed_young(None))


def describe_unseen(distance: NDArray[np.float64]) -> list[str]:
    """A line for a person if too many frames are further from what was fitted than they should be.

    `distance`: (n,) of the frames that moved, as of `ForceReader.distance`.
    """
    far = distance[distance > 1]
    if len(far) <= _MANY_UNSEEN * len(distance):
        return []
    return [
        f"unseen world: {100 * len(far) / len(distance):.0f}% of the frames that moved do so unlike anything "
        f"that it was trained on (distance {np.median(far):.2g} times what 99% of held-out frames stay in); "
        "intervals are widened by as much, and may still be too narrow"
    ]


def as_prediction(force: NDArray[np.float64], said: ForceMap) -> Prediction:
    """One frame as intervals are asked for it; `force`: (3,) mN as `ForceReader.read` gave it."""
    assert said.motion is not None
    young = said.young_kpa
    map_ = said.magnitude[None] / np.float32(young)
    return Prediction(said.motion[None], force[None] / young, map_, said.grid.pitch_mm)


def net_force(
    density: NDArray[np.float32], still: NDArray[np.float32], kind: str, grid: Grid
) -> NDArray[np.float64]:
    """(T, 3) total force of frames (T, C, N, N), as `ForceReader.read` gives it: less that of `still`.

    `still`: (C, N, N), the answer to no motion; `kind`: `density` or `intensity`.
    """
    if density.shape[1] == 3:
        whole, rest = (part.astype(np.float64).sum((-2, -1)) for part in (density, still))
        return np.asarray((whole - rest) * grid.pitch_mm**2)
    size = total_force(density, kind, grid) - total_force(still[None], kind, grid)
    nothing = np.full_like(size, np.nan)
    return np.stack([np.maximum(size, 0.0), nothing, nothing], axis=1)


def _total(said: ForceMap) -> NDArray[np.float64]:
    """(3,) mN, camera axes; a size alone goes into x."""
    if said.force_mn is not None:
        return said.force_mn
    return np.array([said.total_force_mn, np.nan, np.nan])
