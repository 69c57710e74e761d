"""Trainings of the gap experiment: clips in, errors by sequence out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evidence import cache
from evidence.end_to_end.pipelines import recover_flow
from evidence.gap import gap
from learn.data.clips import Clip
from learn.data.grid import Grid
from learn.evaluation.evaluate import evaluate
from learn.inference.predict import load_model
from learn.settings import TrainingSettings
from learn.settings import replace as changed
from learn.split import Split
from learn.training.train import train
from synth.dataset.store import Sequence as Stored

KEYS = ("force_mae", "map_rmse")  # errors by sequence: total force [mN], density [mN/mm²]; the first decides
Tests = Mapping[str, tuple[Sequence[Clip], str]]  # by name: tested clips, and name of their displacement


@dataclass(frozen=True)
class Training:
    """One network of the experiment."""

    kind: str  # I: ideal flow; R: recovered; N: ideal with fitted noise; mixed: both
    flow: str  # back end of the recovered flow for training and testing; for I only for testing
    seed: int


def with_flow(sequence: Stored, clip: Clip, backend: str, grid: Grid, work: Path) -> Clip:
    """The clip with the flow recovered by another back end, as in the paper's pipeline, cached in `work`.

    Only the instrument is masked, not highlights, as in masks drawn by hand.
    """

    def make() -> Clip:
        return recover_flow(sequence, clip, backend, sequence["tool"][...].astype(bool), grid)[0]

    key = cache.key(clip.content_hash, backend, grid.size, grid.extent_mm)
    return cache.clip(work / "flow" / key, make)


def with_fitted_noise(clips: Sequence[Clip], fit: Sequence[int], seed: int) -> tuple[list[Clip], gap.Noise]:
    """Clips with recovered flow replaced by ideal flow plus noise, which is fitted on the clips `fit`."""
    chosen = [clips[i] for i in fit]
    noise = gap.fit_noise(
        [np.asarray(c.displacement["ideal"]) for c in chosen],
        [np.asarray(c.displacement["recovered"]) for c in chosen],
        [c.mask for c in chosen],
    )
    made = []
    for k, clip in enumerate(clips):
        rng = np.random.default_rng([seed, k])
        noisy = noise.add(np.asarray(clip.displacement["ideal"]), clip.mask, rng)
        made.append(replace(clip, displacement={**clip.displacement, "recovered": noisy}))
    return made, noise


def carry_out(
    training: Training,
    clips: Sequence[Clip],
    split: Split,
    settings: TrainingSettings,
    tests: Tests,
    work: Path,
) -> dict[str, Any]:
    """The training's errors in every test, cached in `work`; an interrupted training is continued.

    Clips have ideal and recovered displacement; only fit and select of `split` are used. `input` and `seed`
    of the settings are set by the training.
    """
    kind = {"I": "ideal", "R": "recovered", "N": "recovered", "mixed": "mixed"}[training.kind]
    chosen = changed(settings, input=kind, seed=training.seed)
    # Training on ideal flow doesn't depend on the tested flow estimator.
    flow = "" if training.kind == "I" else f"-{training.flow}"
    used = [clips[i].content_hash for i in (*split.fit, *split.select)]
    trained = [training.kind, flow, chosen.model_dump(), len(split.fit), used]
    model = work / "models" / f"{training.kind}{flow}-seed{training.seed}-{cache.key(*trained)}"
    name = f"{training.kind}-{training.flow}-seed{training.seed}"

    def compute() -> dict[str, Any]:
        fitted, noise = list(clips), None
        if training.kind == "N":
            fitted, noise = with_fitted_noise(fitted, split.fit, training.seed)
        train(fitted, split, chosen, model)
        predictor = load_model(model)
        errors = {
            test: {key: [row[key] for row in evaluate(predictor, part, source).per_clip()] for key in KEYS}
            for test, (part, source) in tests.items()
        }
        return {"noise": noise and vars(noise), "errors": errors}

    tested = {test: [c.content_hash for c in part] for test, (part, _) in tests.items()}
    key = cache.key(*trained, training.flow, tested)
    done: dict[str, Any] = cache.result(work / "runs", name, key, compute)
    return done
