"""Who reads the force for the learning curves: fitted on so many sequences, asked about others."""

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

from bench.methods import baselines
from evidence import cache as kept
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
from synth.errors import UserError

Floats = NDArray[np.float64]
Answer = Callable[[Clip], Floats]

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
"""Displacement that is fitted on and asked with, by eyes: what flow finds, and the truth, whose error is of
what the surface doesn't show."""
GRID = Grid(64)
SAME = "same world"
"""What is asked about: sequences of the dataset that was fitted on, but none of those."""
_COMPONENTS = 200  # principal components of displacement
_BASIS = 150  # sequences that they are found on
_BATCH, _LEAST, _MOST = 16, 4, 80  # frames a batch, epochs


@dataclass(frozen=True)
class Reader:
    """One point of a curve."""

    model: str
    input: str
    eyes: int
    size: int
    """Sequences fitted on: the first ones behind those that are asked and those that choose."""

    @property
    def slug(self) -> str:
        return f"{self.model}-{self.input}-{self.eyes}-{self.size}"

    @property
    def source(self) -> str:
        """The displacement that it is fitted on and asked with, as clips name it."""
        return SOURCES[self.input][self.eyes]


@dataclass(frozen=True)
class World:
    """What is fitted on and asked, and where that stays."""

    data: Path
    unseen: tuple[Path, ...]
    asked: int
    choosing: int
    steps: int
    work: Path

    def check(self) -> int:
        """Largest number of sequences to fit on. Raises UserError if none is left."""
        left = len(Dataset(self.data)) - self.asked - self.choosing
        if left < 1:
            raise UserError(f"{self.data}: too few sequences for those that choose and those that are asked")
        return left

    def pack(self) -> None:
        """Reads every dataset once: later readings, in other processes, are of packed arrays."""
        for root in (self.data, *self.unseen):
            _load(root, self.work)

    def generation_cpu_s(self) -> float:
        """CPU time of a sequence, the median: the first of a process compiles for all of them."""
        return _generation_cpu_s(self.data)

    def counts(self) -> dict[str, int]:
        """Sequences asked about."""
        return {SAME: self.asked} | {root.name: len(Dataset(root)) for root in self.unseen}

    def rows(self, one: Reader) -> list[dict[str, Any]]:
        """What the reader errs by in every world asked about."""
        set_threads(1)
        clips = _load(self.data, self.work)
        # In front, so that a dataset that grows is asked the same.
        rest = self.asked + self.choosing
        fit = clips[rest : rest + one.size]
        choose = clips[self.asked :][: min(self.choosing, max(4, one.size // 5))]
        tests = {SAME: (clips[: self.asked], _bare(self.data)[: self.asked])}
        tests |= {root.name: (_load(root, self.work), _bare(root)) for root in self.unseen}
        used = [
            clip.content_hash for part in (fit, choose, *(one for one, _ in tests.values())) for clip in part
        ]
        key = kept.key(asdict(one), self.steps, used)

        def compute() -> list[dict[str, Any]]:
            began = time.process_time()
            answer = self._fitted(one, fit, choose, key)
            spent = time.process_time() - began
            hours = (spent + one.size * self.generation_cpu_s()) / 3600
            return [
                asdict(one)
                | {"asked": name, "fit_cpu_s": round(spent, 1), "cpu_h": round(hours, 3)}
                | figures(answer, part, bare)
                for name, (part, bare) in tests.items()
            ]

        found: list[dict[str, Any]] = kept.result(self.work / "rows", one.slug, key, compute)
        return found

    def _fitted(self, one: Reader, fit: Sequence[Clip], choose: Sequence[Clip], key: str) -> Answer:
        if one.model not in NETWORKS:
            return _by_components(one, fit)
        settings = network_settings(one, self.steps, sum(clip.frames for clip in fit))
        folder = self.work / "networks" / f"{one.slug}-{key}"
        predictor = models.train_network(fit, choose, settings, folder)
        return partial(models.read_force, predictor, source=one.source)


@cache
def _load(root: Path, work: Path) -> list[Clip]:
    wanted = [source for by_eyes in SOURCES.values() for source in by_eyes.values()]
    return load_clips(root, GRID, wanted, cache=work / "clips")


@cache
def _generation_cpu_s(root: Path) -> float:
    timings = [one.attrs["timings"].values() for one in Dataset(root)]
    return float(np.median([sum(t["cpu_s"] for t in spent if isinstance(t, dict)) for spent in timings]))


@cache
def _bare(root: Path) -> list[bool]:
    """Which sequences have no membrane."""
    return [not one.attrs["scenario"]["tissue"].get("membrane") for one in Dataset(root)]


def _by_components(one: Reader, fit: Sequence[Clip]) -> Answer:
    """Ridge or nearest neighbours on principal components of displacement, in eight turns."""
    small = [coarse(clip) for clip in fit]
    # Not centred: no motion stays zero.
    x, _, _ = models.samples(small[:_BASIS], one.source)
    basis = TruncatedSVD(min(_COMPONENTS, min(x.shape) - 1), random_state=0).fit(x)
    features, forces, groups = [], [], []
    for start in range(0, len(small), _BASIS):
        x, force, group = models.samples(small[start : start + _BASIS], one.source)
        features.append(basis.transform(x))
        forces.append(force)
        groups.append(group + start)
    x, force, group = np.concatenate(features), np.concatenate(forces), np.concatenate(groups)
    regressor: Any = models.fit_ridge(x, force, group) if one.model == RIDGE else baselines.nearest(x, force)
    return lambda clip: (
        clip.young_kpa * np.asarray(regressor.predict(basis.transform(models.rows(coarse(clip), one.source))))
    )


def network_settings(one: Reader, steps: int, frames: int) -> TrainingSettings:
    """Of a network's training: as many epochs as make up `steps` batches of the `frames` there are."""
    arch = NETWORKS[one.model] | {"output": "vector", "confidence": True, "relative": True}
    return TrainingSettings.model_validate(
        {
            "size": GRID.size,
            "arch": arch | {"depth": one.eyes == 2},
            "loss": "mse-frame",
            "input": one.source,
            "epochs": int(np.clip(round(steps * _BATCH / frames), _LEAST, _MOST)),
            "batch": _BATCH,
            "learning_rate": 2e-3,
            "schedule": "cosine",
            "seed": 0,
        }
    )


def figures(answer: Answer, part: Sequence[Clip], bare: Sequence[bool]) -> dict[str, Any]:
    """Errors of the force as parts of it, means over sequences with their intervals, and the gain.

    Args:
        answer: who is asked.
        part: what about.
        bare: which of them have no membrane.

    Returns:
        `whole`, `across`, `along` the line of sight, `force_size`, and of those without a membrane `bare`,
        each [mean, low, high] or None; `gain` of predicted on true force, by size; `slope` of true on
        predicted.
    """
    predicted, true = [answer(clip) for clip in part], [clip.force for clip in part]
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
    # Whoever answers with the mean of what is possible says less than there is (a gain under 1), and what
    # there is, is on average what he says (a slope of 1): a gain is a fault only where the slope isn't 1.
    both = float(all_predicted @ all_true)
    row["gain"] = round(both / float(all_true @ all_true), 3)
    row["slope"] = round(both / max(float(all_predicted @ all_predicted), 1e-30), 3)
    return row


def map_figures(predictor: Predictor, part: Sequence[Clip], source: str) -> dict[str, Any]:
    """R² of the force map over all cells, and the share of contact-free area that says a force."""
    known = evaluate(predictor, part, source).summary()
    return {"map_r2": round(known["map_r2_pooled"], 4), "ghosts": round(known["false_positive_relative"], 5)}
