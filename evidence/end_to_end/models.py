"""What answers with a force: rules fitted on flow, physics alone, a network.

The force turns with the picture, so fitted rules see every sequence in its eight turns and mirrors, as the
network does by drawing them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bench.methods import baselines, physics, posterior
from bench.methods.compliance import TissueKind
from bench.methods.protocol import Field
from learn.data.clips import Clip
from learn.inference.predict import Predictor, load_model
from learn.settings import TrainingSettings
from learn.split import Split
from learn.training import batches
from learn.training.train import train
from synth.flow.confidence import deviation

Floats = NDArray[np.float64]
Answer = Callable[[Clip], Floats]
"""A clip with `recovered` displacement → force (T, 3) mN, camera axes."""

RIDGE, NEAREST, PHYSICS = "ridge on flow", "k-NN on flow", "physics"
_FOLDS = 4
_MM_PER_PX = 0.12  # of the bench's scenes; flow's deviations are in pixels
_STRENGTHS = np.geomspace(1e-8, 1e2, 21)


def build(model: str, fit: Sequence[Clip]) -> Answer:
    """A model, fitted on sequences unless it is physics alone."""
    if model == PHYSICS:
        return lambda clip: (
            clip.young_kpa
            * np.stack(
                [
                    read_bare(moved, clip.mask, sure)
                    for moved, sure in zip(clip.displacement["recovered"], clip.confidence, strict=True)
                ]
            )
        )
    x, force, group = samples(fit)
    live = np.abs(x).max(axis=0) > 0
    x = x[:, live]
    regressor: Any = baselines.nearest(x, force) if model == NEAREST else fit_ridge(x, force, group)
    return lambda clip: clip.young_kpa * np.asarray(regressor.predict(rows(clip)[:, live]))


def read_bare(moved: Field, mask: Field, sure: Field) -> Floats:
    """Physics of one frame of still tissue without a membrane, a rule as the baselines are."""
    spread = np.broadcast_to(_MM_PER_PX * deviation(sure), moved.shape)
    seen = physics.observe(moved, spread, mask)
    return posterior.infer(
        posterior.load_basis(len(moved), TissueKind()), seen, np.zeros(len(moved))
    ).force.mean


def fit_ridge(x: Floats, force: Floats, group: NDArray[np.intp]) -> Any:
    """Ridge from displacement to force over E; arguments as `samples` gives them."""
    # Every sequence weighs alike, as it does in the score: what is linear may be scaled.
    size = np.array([np.sqrt(np.square(force[group == k]).sum(axis=1).mean()) for k in np.unique(group)])
    x, force = x / size[group, None], force / size[group, None]
    # Flow shows the force along the line of sight far less well than that across it.
    return baselines.ridge(x, force, group % _FOLDS, _STRENGTHS, (slice(0, 2), slice(2, 3)))


def turned(clip: Clip) -> list[Clip]:
    """The clip in its four quarter turns and their mirrors, all arrays and the force turned with it."""
    return [_turned(clip, turn) for turn in range(8)]


def _turned(clip: Clip, turn: int) -> Clip:
    def each(fields: NDArray[Any]) -> NDArray[Any]:
        return batches.turned(torch.from_numpy(np.array(fields)), turn).numpy()

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
    clips = [turned(clip) for clip in fit]
    x = np.concatenate([rows(t, source) for turns in clips for t in turns])
    force = np.concatenate([t.force / t.young_kpa for turns in clips for t in turns])
    group = np.repeat(np.arange(len(fit)), [sum(t.frames for t in turns) for turns in clips])
    return x, force, group


def train_network(
    fit: Sequence[Clip], choose: Sequence[Clip], settings: TrainingSettings, folder: Path
) -> Predictor:
    """A network of vectors; `choose` chooses the epoch. Kept in `folder`."""
    clips = [*fit, *choose]
    split = Split(tuple(range(len(fit))), tuple(range(len(fit), len(clips))), ())
    train(clips, split, settings, folder)
    return load_model(folder)


def read_force(predictor: Predictor, clip: Clip, source: str, told: bool = False) -> Floats:
    """Force (T, 3) mN that a network of vectors gives for a displacement (`told`: and membrane), summed."""
    moved = np.asarray(clip.displacement[source])
    membrane = clip.membrane if told else "unknown"
    density = predictor.density(moved, clip.mask, clip.young_kpa, clip.confidence_of(source), membrane)
    return np.asarray(density.astype(np.float64).sum(axis=(2, 3)) * predictor.grid.pitch_mm**2)


def errors(predicted: Sequence[Floats], true: Sequence[Floats]) -> dict[str, list[float]]:
    """Root mean square error of the force as a part of the force's own, by sequence: (T, 3) mN, camera axes.

    Whole, and its parts across and along the line of sight.
    """
    found: dict[str, list[float]] = {"errors": [], "across": [], "along": []}
    for answer, force in zip(predicted, true, strict=True):
        own = np.square(force).sum(axis=1).mean()
        off = np.square(answer - force).mean(axis=0) / own
        for name, parts in (("errors", off), ("across", off[:2]), ("along", off[2:])):
            found[name].append(float(np.sqrt(parts.sum())))
    return found
