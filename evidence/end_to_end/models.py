"""What answers with a force in `bench pareto end-to-end`: rules fitted on flow, physics alone, a network.

The force on the tissue turns with the picture, so the fitted rules see every sequence in its eight turns and
mirrors, as the network does by drawing them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.methods import baselines
from bench.methods.baselines import GRID
from learn.data.clips import Clip
from learn.settings import Settings, preset
from learn.training import batches

if TYPE_CHECKING:
    from learn.inference.predict import Predictor

Floats = NDArray[np.float64]
Answer = Callable[[Clip], Floats]
"""A clip with `recovered` displacement → force (T, 3) mN, camera axes."""

RIDGE, NEAREST, PHYSICS, NETWORK = "ridge on flow", "k-NN on flow", "Tikhonov near the contact", "D2FNet tiny"
UNLEARNT = (PHYSICS,)

_TURNS = 8
_FOLDS = 4
_STRENGTHS = np.geomspace(1e-8, 1e2, 21)


def build(model: str, fit: Sequence[Clip], folder: Path, epochs: int, seed: int) -> Answer:
    """A model fitted on sequences; a network's training is kept in `folder`."""
    if model == NETWORK:
        return _network(fit, folder, epochs, seed)
    if model in UNLEARNT:
        rule = baselines.physical_rules()[model]
        return lambda clip: (
            clip.young_kpa
            * np.stack(
                [
                    rule(moved, clip.mask, sure)
                    for moved, sure in zip(clip.displacement["recovered"], clip.confidence, strict=True)
                ]
            )
        )
    x, force, group = samples(fit)
    live = np.abs(x).max(axis=0) > 0
    x = x[:, live]
    regressor: Any = baselines.nearest(x, force) if model == NEAREST else fit_ridge(x, force, group)
    return lambda clip: clip.young_kpa * np.asarray(regressor.predict(rows(clip)[:, live]))


def fit_ridge(x: Floats, force: Floats, group: NDArray[np.intp]) -> Any:
    """Ridge from displacement to force over E; arguments as `samples` gives them."""
    # Every sequence weighs alike, as it does in the score: what is linear may be scaled.
    size = np.array([np.sqrt(np.square(force[group == k]).sum(axis=1).mean()) for k in np.unique(group)])
    x, force = x / size[group, None], force / size[group, None]
    # Flow shows the force along the line of sight far less well than that across it.
    parts = (slice(0, 2), slice(2, 3))
    return baselines.ridge(x, force, group % _FOLDS, _STRENGTHS, parts)


def turned(clip: Clip) -> list[Clip]:
    """The clip in its four quarter turns and their mirrors, all arrays and the force turned with it."""
    return [_turned(clip, quarter, mirror) for mirror in (False, True) for quarter in range(4)]


def _turned(clip: Clip, quarter: int, mirror: bool) -> Clip:
    def each(fields: NDArray[Any]) -> NDArray[Any]:
        return np.stack([batches.turned(field, quarter, mirror) for field in fields])

    return replace(
        clip,
        displacement={name: each(moved) for name, moved in clip.displacement.items()},
        mask=each(clip.mask[None, None])[0, 0],
        confidence=each(clip.confidence[:, None])[:, 0],
        density=each(clip.density),
        force=each(clip.force[..., None, None])[..., 0, 0],
    )


def rows(clip: Clip, source: str = "recovered") -> Floats:
    """Displacement of a clip, (T, 2 N N) mm, of two eyes (T, 3 N N)."""
    return (clip.displacement[source] * clip.mask).reshape(clip.frames, -1).astype(np.float64)


def samples(fit: Sequence[Clip], source: str = "recovered") -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Frames of all turns: displacement, force over E (n, 3), and which sequence; its turns are together."""
    clips = [t for clip in fit for t in turned(clip)]
    x = np.concatenate([rows(clip, source) for clip in clips])
    force = np.concatenate([clip.force / clip.young_kpa for clip in clips])
    group = np.concatenate([np.full(clip.frames, k // _TURNS) for k, clip in enumerate(clips)])
    return x, force, group


def network_settings(epochs: int, seed: int) -> Settings:
    """Of the network's training."""
    return preset("tiny", size=GRID.size, epochs=epochs, input="recovered", seed=seed)


def _network(fit: Sequence[Clip], folder: Path, epochs: int, seed: int) -> Answer:
    return train_network(fit, network_settings(epochs, seed), folder)


def train_network(fit: Sequence[Clip], settings: Settings, folder: Path) -> Answer:
    """A network of vectors; the first fifth of `fit` chooses the epoch. Its training is kept in `folder`."""
    from learn.data.split import Split
    from learn.inference.predict import load_predictor
    from learn.training.train import train

    select = max(2, len(fit) // 5)
    train(fit, Split(tuple(range(select, len(fit))), tuple(range(select)), ()), settings, folder)
    return partial(read_force, load_predictor(folder), source="recovered")


def read_force(predictor: Predictor, clip: Clip, source: str) -> Floats:
    """Force (T, 3) mN that a network of vectors says of a displacement: its map, summed."""
    moved = np.asarray(clip.displacement[source])
    said, _ = predictor.answer(moved, clip.mask, clip.young_kpa, clip.sure(source))
    return np.asarray(said.astype(np.float64).sum(axis=(2, 3)) * predictor.grid.pitch_mm**2)
