"""Force estimators of the learning curves: fitted on some sequences, tested on others."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import TruncatedSVD

from evidence import cache as stored
from evidence.end_to_end import models
from evidence.mechanics.conditions import coarse
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid
from learn.evaluation.evaluate import evaluate
from learn.evaluation.statistics import interval
from learn.inference.predict import Predictor
from learn.settings import TrainingSettings
from learn.training.threads import set_threads
from synth.dataset.store import Dataset

Floats = NDArray[np.float64]
Estimate = Callable[[Clip], Floats]  # clip → force (T, 3) mN, camera axes

RIDGE, NEAREST, SMALL, LARGE = "ridge", "k-NN", "d2fnet-s", "D2FNet"
NETWORKS = {
    SMALL: {"width": 16, "stem": 4, "levels": 3, "dropout": 0.0},
    LARGE: {"width": 32, "stem": 2, "levels": 4, "dropout": 0.05},
}
MODELS = (RIDGE, NEAREST, *NETWORKS)
SOURCES = {
    "recovered": {1: "recovered", 2: "motion"},
    "exact": {1: "ideal", 2: "motion-ideal"},
}
"""Displacement for fitting and testing, by number of cameras: recovered, or the ground truth, whose remaining
error is of what the surface doesn't show."""
GRID = Grid(64)
SAME = "in distribution"  # tested sequences of the dataset that estimators are fitted on
_COMPONENTS = 200  # principal components of displacement
_BASIS = 150  # sequences that they are found on
_BATCH, _LEAST, _MOST = 16, 4, 80  # frames a batch, epochs


@dataclass(frozen=True)
class Estimator:
    """One point of a curve."""

    model: str
    input: str
    cameras: int
    size: int  # sequences fitted on

    @property
    def slug(self) -> str:
        return f"{self.model}-{self.input}-{self.cameras}-{self.size}"

    @property
    def source(self) -> str:
        """Name of its displacement in clips."""
        return SOURCES[self.input][self.cameras]


@dataclass(frozen=True)
class Experiment:
    """Datasets and sizes of the learning curves, and the folder of intermediate results."""

    data: Path  # its first sequences are tested, the next ones select an epoch, the others are fitted on
    ood: tuple[Path, ...]  # only tested
    tested: int
    selecting: int
    steps: int  # about as many batches train a network
    work: Path

    def pack(self) -> None:
        """Reads every dataset once, so that other processes read packed arrays."""
        for root in (self.data, *self.ood):
            _load(root, self.work)

    def rows(self, one: Estimator) -> list[dict[str, Any]]:
        """Errors of an estimator, one row for each tested dataset."""
        set_threads(1)
        clips = _load(self.data, self.work)
        # Tested sequences come first, so that they stay the same as the dataset grows.
        first = self.tested + self.selecting
        fit = clips[first : first + one.size]
        select = clips[self.tested :][: min(self.selecting, max(4, one.size // 5))]
        tests = {SAME: (clips[: self.tested], _bare(self.data)[: self.tested])}
        tests |= {root.name: (_load(root, self.work), _bare(root)) for root in self.ood}
        used = [
            clip.content_hash for part in (fit, select, *(one for one, _ in tests.values())) for clip in part
        ]
        key = stored.key(asdict(one), self.steps, used)

        def compute() -> list[dict[str, Any]]:
            began = time.process_time()
            estimate = self._fitted(one, fit, select, key)
            spent = time.process_time() - began
            hours = (spent + one.size * generation_cpu_s(self.data)) / 3600
            return [
                asdict(one)
                | {"tested": name, "fit_cpu_s": round(spent, 1), "cpu_h": round(hours, 3)}
                | figures(estimate, part, bare)
                for name, (part, bare) in tests.items()
            ]

        found: list[dict[str, Any]] = stored.result(self.work / "rows", one.slug, key, compute)
        return found

    def _fitted(self, one: Estimator, fit: Sequence[Clip], select: Sequence[Clip], key: str) -> Estimate:
        if one.model not in NETWORKS:
            return _by_components(one, fit)
        settings = network_settings(one, self.steps, sum(clip.frames for clip in fit))
        folder = self.work / "networks" / f"{one.slug}-{key}"
        predictor = models.train_network(fit, select, settings, folder)
        return partial(models.read_force, predictor, source=one.source)


@cache
def _load(root: Path, work: Path) -> list[Clip]:
    wanted = [source for by_cameras in SOURCES.values() for source in by_cameras.values()]
    return load_clips(root, GRID, wanted, cache=work / "clips")


@cache
def generation_cpu_s(root: Path) -> float:
    """Median CPU time of rendering a sequence [s]; the first of a process includes compilation."""
    return float(np.median([sum(one.stages_cpu_s.values()) for one in Dataset(root)]))


@cache
def _bare(root: Path) -> list[bool]:
    """Whether each sequence lacks a membrane."""
    return [not one.attrs["scenario"]["tissue"].get("membrane") for one in Dataset(root)]


def _by_components(one: Estimator, fit: Sequence[Clip]) -> Estimate:
    """Ridge or nearest neighbours on principal components of displacement, in eight orientations."""
    small = [coarse(clip) for clip in fit]
    # Not centred, so that zero motion stays zero.
    x, _, _ = models.samples(small[:_BASIS], one.source)
    basis = TruncatedSVD(min(_COMPONENTS, min(x.shape) - 1), random_state=0).fit(x)
    features, forces, groups = [], [], []
    for start in range(0, len(small), _BASIS):
        x, force, group = models.samples(small[start : start + _BASIS], one.source)
        features.append(basis.transform(x))
        forces.append(force)
        groups.append(group + start)
    x, force, group = np.concatenate(features), np.concatenate(forces), np.concatenate(groups)
    regressor: Any = models.fit_ridge(x, force, group) if one.model == RIDGE else models.fit_nearest(x, force)
    return lambda clip: (
        clip.young_kpa * np.asarray(regressor.predict(basis.transform(models.rows(coarse(clip), one.source))))
    )


def network_settings(one: Estimator, steps: int, frames: int) -> TrainingSettings:
    """Training settings of a network: about `steps` batches over a training set of `frames` frames."""
    arch = NETWORKS[one.model] | {"output": "vector", "confidence": True, "relative": True}
    return TrainingSettings.model_validate(
        {
            "size": GRID.size,
            "arch": arch | {"depth": one.cameras == 2},
            "loss": "mse-frame",
            "input": one.source,
            "epochs": int(np.clip(round(steps * _BATCH / frames), _LEAST, _MOST)),
            "batch": _BATCH,
            "learning_rate": 2e-3,
            "schedule": "cosine",
            "seed": 0,
        }
    )


def figures(estimate: Estimate, part: Sequence[Clip], bare: Sequence[bool]) -> dict[str, Any]:
    """Errors relative to the force, means over the sequences `part` with intervals, and the gain.

    Returns:
        `whole`, `across`, `along` the line of sight, `force_size`, and of sequences without a membrane
        `bare`, each [mean, low, high] or None; of the forces' sizes the `gain` of predicted on true and the
        `slope` of true on predicted.
    """
    predicted, true = [estimate(clip) for clip in part], [clip.force for clip in part]
    sizes, own = ([np.linalg.norm(force, axis=1) for force in forces] for forces in (predicted, true))
    off = models.errors(predicted, true)
    found = {
        "force_size": [
            float(np.sqrt(np.square(a - b).mean() / np.square(b).mean()))
            for a, b in zip(sizes, own, strict=True)
        ],
        "whole": off["errors"],
        "across": off["across"],
        "along": off["along"],
        "bare": [e for e, alone in zip(off["errors"], bare, strict=True) if alone],
    }
    row: dict[str, Any] = dict.fromkeys(found)
    for name, values in found.items():
        if values:
            mean = interval(np.array(values), np.random.default_rng(0))
            row[name] = [round(value, 4) for value in (mean.mean, mean.low, mean.high)]
    all_predicted, all_true = np.concatenate(sizes), np.concatenate(own)
    # The mean of a posterior shrinks towards zero (gain below 1) and is right on average (slope of 1): a gain
    # is a fault only where the slope differs from 1.
    both = float(all_predicted @ all_true)
    row["gain"] = round(both / float(all_true @ all_true), 3)
    row["slope"] = round(both / max(float(all_predicted @ all_predicted), 1e-30), 3)
    return row


def map_figures(predictor: Predictor, part: Sequence[Clip], source: str) -> dict[str, Any]:
    """R² of the force map over all cells, and the share of contact-free area with a force."""
    known = evaluate(predictor, part, source).summary()
    return {
        "map_r2": round(known["map_r2_pooled"], 4),
        "false_positives": round(known["false_positive_relative"], 5),
    }
