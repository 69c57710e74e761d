"""Intervals beside what a network says: of the force, of its components, of the map.

Half of an interval's width is the expected size of the error (`Scale`), times how far beyond what was fitted
the frame is (`World`, and an answer above all that the scale was fitted on), times a factor that makes the
stated share of new sequences' frames lie within (`conformal.quantile`). All but the factor is fitted on other
sequences than the factor is, and the answer itself on others again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict
from scipy import ndimage

from learn.uncertainty import conformal
from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.features import ANSWER, answer_features
from learn.uncertainty.scale import Scale, fit_scale
from learn.uncertainty.world import World
from synth.errors import UserError
from synth.job.types import Positive

Floats = NDArray[np.float64]

LEVEL = LEVELS[0]
"""What is given where only one is."""
_AROUND_MM = 3.0  # how far aside a contact may be found
_LOW_SHARE = 0.01  # of the training data's density: below it all densities are alike
_NEAR = 0.02  # of the training data's density: a cell with so much nearby is at a contact
_LEAST = 1e-3  # of the training data's force and density: no error is expected to be smaller


@dataclass(frozen=True)
class Said:
    """A network's answer to the frames of one film, per unit stiffness, and what is known of them."""

    motion: Floats
    """(T, F) `motion_features`."""
    force: Floats
    """(T, 3) total force in camera axes [mN at 1 kPa]; of a network of sizes the size in x, the rest NaN."""
    magnitude: NDArray[np.float32]
    """(T, N, N) ≥ 0, the map [mN/mm² or mN, at 1 kPa]."""
    pitch_mm: float

    @property
    def size(self) -> Floats:
        """(T,) of the total force."""
        return np.asarray(np.sqrt(np.nansum(self.force**2, axis=1)))

    @property
    def centre(self) -> Floats:
        """(T, 3) the middle of the components' intervals: 0 where the network gives no direction."""
        directed = np.isfinite(self.force).all(axis=1, keepdims=True)
        return np.asarray(np.where(directed, self.force, 0.0))


@dataclass(frozen=True)
class Truth:
    """What is so, per unit stiffness."""

    force: Floats
    """(T, 3)."""
    magnitude: NDArray[np.float32]
    """(T, N, N)."""


@dataclass(frozen=True)
class Example:
    """One sequence whose truth is known, as intervals are fitted on it: its frames, and some of its cells."""

    unit: int
    """Equal where sequences are not exchangeable: of one brain."""
    motion: Floats
    """(T, F)."""
    features: Floats
    """(T, G) of the frames' errors."""
    error: Floats
    """(T, 4) of the force's size and components, ≥ 0 [mN at 1 kPa]."""
    cell_frame: NDArray[np.int64]
    """(n,) which frame a cell is of."""
    cell_features: Floats
    """(n, G + 2)."""
    cell_error: Floats
    """(n,) ≥ 0."""


@dataclass(frozen=True)
class Spread:
    """How large an error may be."""

    scale: Scale
    factors: dict[str, Positive]
    """By level: what the scale is multiplied by."""

    def half(self, features: Floats, level: float) -> Floats:
        """(...,) half the width of the interval of `level`, before it is widened, for features (..., F)."""
        return self.scale.predict(features) * self.factors[str(level)]


@dataclass(frozen=True)
class Band:
    """Lower and upper ends, both in the unit of what they are of."""

    low: Floats
    """(T,) of the size."""
    high: Floats
    axes_low: Floats
    """(T, 3) of the components in camera axes."""
    axes_high: Floats

    def times(self, young_kpa: float) -> Band:
        """Of tissue so stiff [kPa], what this is per unit stiffness."""
        return Band(*(young_kpa * end for end in (self.low, self.high, self.axes_low, self.axes_high)))


@dataclass(frozen=True)
class Intervals:
    """What a model's card holds of them."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    features: tuple[str, ...]
    """Names of those of a frame that the scales go by."""
    force_unit: Positive
    """Training data's total force [mN at 1 kPa]."""
    map_unit: Positive
    """Training data's density [mN/mm² (or mN) at 1 kPa]."""
    size: Spread
    axes: tuple[Spread, Spread, Spread]
    map: Spread
    """Of cells near which the answer is as good as nothing."""
    contact: Spread
    """Of all others: they are few, and err more."""
    world: World
    source: str
    """Displacement that they hold for, as in `learn.data.clips.FIELDS`."""
    units: int
    """Exchangeable units that the factors come from: brains, or sequences where one brain is shared."""
    sequences: int
    """How many sequences those are."""

    def __post_init__(self) -> None:
        frame, count = len(self.features), len(self.features) - len(ANSWER)
        for spread, wanted in (
            (self.size, frame),
            *((one, frame) for one in self.axes),
            (self.map, frame + 2),
            (self.contact, frame + 2),
        ):
            rule = spread.scale
            if not len(rule.slopes) == len(rule.low) == len(rule.high) == wanted:
                raise ValueError(f"a scale is not of {wanted} features")
            if spread.factors.keys() != {str(level) for level in LEVELS}:
                raise ValueError(f"levels are not {', '.join(map(str, LEVELS))}")
        if [len(row) for row in (self.world.middle, *self.world.precision)] != [count] * (count + 1):
            raise ValueError(f"the world is not of {count} features")

    def bound(self, said: Said, level: float = LEVEL) -> Band:
        """Intervals of the force of frames, per unit stiffness. UserError for another level."""
        self._check(level)
        features = frame_features(said, self.force_unit)
        wide = self._widening(said.motion, features)
        half = wide * self.size.half(features, level)
        axes = np.stack([wide * one.half(features, level) for one in self.axes], axis=1)
        low = np.maximum(said.size - half, 0.0)
        return Band(low, said.size + half, said.centre - axes, said.centre + axes)

    def bound_map(self, said: Said, level: float = LEVEL) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Ends of the interval of each cell of the map, (T, N, N) twice; unit and errors as `bound`."""
        self._check(level)
        features = frame_features(said, self.force_unit)
        cells = cell_features(said, features, self.map_unit)
        half = np.where(_at_contact(cells), self.contact.half(cells, level), self.map.half(cells, level))
        half = half * self._widening(said.motion, features)[:, None, None]
        low = np.maximum(said.magnitude - half, 0.0)
        return low.astype(np.float32), (said.magnitude + half).astype(np.float32)

    def _check(self, level: float) -> None:
        if str(level) not in self.size.factors:
            raise UserError(f"level {level:g}: the model has intervals of {', '.join(self.size.factors)}")

    def _widening(self, motion: Floats, features: Floats) -> Floats:
        """(T,) ≥ 1."""
        return _widen(self.world, self.size.scale, motion, features)


def frame_features(said: Said, force_unit: float) -> Floats:
    """(T, F + 2) what the errors of frames are predicted from: motion, size and area of the answer."""
    answer = answer_features(said.size / force_unit, said.magnitude, said.pitch_mm**2)
    return np.concatenate([said.motion, answer], axis=1)


def cell_features(said: Said, frames: Floats, map_unit: float) -> Floats:
    """(T, N, N, G + 2) the same of each cell: its frame's (T, G), the map there, and the most nearby."""
    reach = 2 * max(1, round(_AROUND_MM / said.pitch_mm)) + 1
    near = ndimage.maximum_filter(said.magnitude, size=(1, reach, reach), mode="constant")
    own = np.log(np.stack([said.magnitude, near], axis=-1, dtype=np.float64) / map_unit + _LOW_SHARE)
    whole = np.broadcast_to(frames[:, None, None], (*said.magnitude.shape, frames.shape[1]))
    return np.concatenate([whole, own], axis=-1)


def make_example(
    said: Said,
    truth: Truth,
    mask: NDArray[np.float32],
    unit: int,
    units: tuple[float, float],
    rng: np.random.Generator,
    most_cells: int = 2000,
) -> Example:
    """A sequence's errors; `mask`: (N, N) tissue; `units`: `force_unit` and `map_unit` of `Intervals`."""
    features = frame_features(said, units[0])
    off = np.abs(np.linalg.norm(truth.force, axis=1) - said.size)
    every = np.flatnonzero(np.broadcast_to(mask > 0, said.magnitude.shape))
    chosen = rng.choice(every, min(most_cells, len(every)), replace=False)
    cells = cell_features(said, features, units[1]).reshape(-1, features.shape[1] + 2)[chosen]
    return Example(
        unit=unit,
        motion=said.motion,
        features=features,
        error=np.column_stack([off, np.abs(truth.force - said.centre)]),
        cell_frame=chosen // mask.size,
        cell_features=cells,
        cell_error=np.abs(truth.magnitude - said.magnitude).reshape(-1)[chosen].astype(np.float64),
    )


def fit(
    chosen: Sequence[Example],
    kept: Sequence[Example],
    world: World,
    names: tuple[str, ...],
    units: tuple[float, float],
    source: str,
) -> Intervals:
    """Scales from `chosen`, factors from `kept`; arguments else as the fields of `Intervals`.

    The two share no unit, and neither one with what the network was fitted on. Raises UserError if `kept`
    has fewer units than the highest level needs.
    """
    count, least = len({one.unit for one in kept}), conformal.least_units(LEVELS[0])
    if count < least:
        raise UserError(f"{count} brains are kept for intervals; {LEVELS[0]:.0%} needs {least}")
    features, weight = _stacked(chosen, "features"), _weights([len(one.features) for one in chosen])
    error = _stacked(chosen, "error")
    scales = [fit_scale(features, e, weight, _LEAST * units[0]) for e in error.T]
    wide = [_widen(world, scales[0], one.motion, one.features) for one in kept]
    both = list(zip(kept, wide, strict=True))
    spreads = [
        _spread(scale, kept, [one.error[:, k] / (w * scale.predict(one.features)) for one, w in both])
        for k, scale in enumerate(scales)
    ]
    return Intervals(
        features=(*names, *ANSWER),
        force_unit=units[0],
        map_unit=units[1],
        size=spreads[0],
        axes=(spreads[1], spreads[2], spreads[3]),
        map=_cell_spread(chosen, kept, wide, units[1], near=False),
        contact=_cell_spread(chosen, kept, wide, units[1], near=True),
        world=world,
        source=source,
        units=count,
        sequences=len(kept),
    )


def _cell_spread(
    chosen: Sequence[Example], kept: Sequence[Example], wide: Sequence[Floats], unit: float, *, near: bool
) -> Spread:
    """Scale and factors of the cells at a contact or of the others (conformal by class: Vovk 2012).

    Of all cells where too few units have any of that class.
    """
    least = conformal.least_units(LEVELS[0])
    of_class = [_at_contact(one.cell_features) == near for one in (*chosen, *kept)]
    seen = len({one.unit for one, part in zip(kept, of_class[len(chosen) :], strict=True) if part.any()})
    if seen < least or not any(part.any() for part in of_class[: len(chosen)]):
        of_class = [np.ones_like(part) for part in of_class]
    first = [(one, part) for one, part in zip(chosen, of_class, strict=False) if part.any()]
    last = [
        (one, w, part) for one, w, part in zip(kept, wide, of_class[len(chosen) :], strict=True) if part.any()
    ]
    scale = fit_scale(
        np.concatenate([one.cell_features[part] for one, part in first]),
        np.concatenate([one.cell_error[part] for one, part in first]),
        _weights([int(part.sum()) for _, part in first]),
        _LEAST * unit,
    )
    scores = [
        (one.cell_error / (w[one.cell_frame] * scale.predict(one.cell_features)))[part]
        for one, w, part in last
    ]
    return _spread(scale, [one for one, _, _ in last], scores)


def _at_contact(cells: Floats) -> NDArray[np.bool_]:
    """(...,) whether the answer says something at or near a cell, of `cell_features` (..., G)."""
    return np.asarray(cells[..., -1] > np.log(_NEAR + _LOW_SHARE))


def _spread(scale: Scale, kept: Sequence[Example], scores: Sequence[Floats]) -> Spread:
    """A scale with its factors; `scores`: of each sequence, (n,) errors as multiples of the scale."""
    by_unit: dict[int, list[Floats]] = {}
    for one, score in zip(kept, scores, strict=True):
        by_unit.setdefault(one.unit, []).append(score)
    together = [np.concatenate(one) for one in by_unit.values()]
    factors = {str(level): max(conformal.quantile(together, level), 1e-9) for level in LEVELS}
    return Spread(scale, factors)


def _widen(world: World, size: Scale, motion: Floats, features: Floats) -> Floats:
    """(T,) how far beyond usual a frame is, times how far its answer is above all of the scale's."""
    place = len(features[0]) - len(ANSWER)
    beyond = np.exp(np.maximum(features[:, place] - size.high[place], 0.0))
    return world.widening(motion) * beyond


def _stacked(examples: Sequence[Example], name: str) -> Floats:
    return np.concatenate([getattr(one, name) for one in examples])


def _weights(counts: Sequence[int]) -> Floats:
    """Every sequence weighs alike."""
    return np.concatenate([np.full(n, 1 / n) for n in counts])
