"""Who reads the force in `bench experiment curves`: fitted on so many sequences, asked about others."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.decomposition import TruncatedSVD

from bench.methods import baselines
from evidence import kept
from evidence.end_to_end import models
from evidence.end_to_end.pipelines import errors
from evidence.gap import gap
from evidence.mechanics.worlds import coarse
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid
from learn.data.split import Split
from learn.evaluation.evaluate import evaluate
from learn.evaluation.statistics import interval
from learn.inference.predict import Predictor, load_predictor
from learn.loss import FRAMEWISE
from learn.network.d2fnet import Architecture
from learn.network.half_space import HalfSpace
from learn.settings import Settings
from learn.settings import replace as replaced
from learn.training.threads import set_threads
from learn.training.train import train
from synth.dataset.store import Dataset
from synth.errors import UserError

Floats = NDArray[np.float64]
Answer = Callable[[Clip], Floats]

PHYSICS, RIDGE, NEAREST, BOOSTING = "half-space", "ridge", "k-NN", "boosting"
SMALL, LARGE = "d2fnet-s", "D2FNet"
MODELS = (PHYSICS, RIDGE, NEAREST, BOOSTING, SMALL, LARGE)
"""What a run compares if it isn't told."""
EXACT = "exact"
INPUTS = ("ideal", "noise", "recovered", "mixed", EXACT)
"""What is fitted on. Everything is asked with recovered motion, `exact` alone with true one: its error is of
what the surface doesn't show, the others' of that and of the flow."""
_SMALL = Architecture(
    width=16, stem=4, levels=3, output="vector", confidence=True, dropout=0.0, relative=True
)
NETWORKS: dict[str, Architecture] = {
    SMALL: _SMALL,
    LARGE: Architecture(
        width=32, stem=2, levels=4, output="vector", confidence=True, dropout=0.05, relative=True
    ),
    f"{SMALL}-absolute": replaced(_SMALL, relative=False),
    f"{SMALL}-channel": replaced(_SMALL, prior="channel"),
    f"{SMALL}-residual": replaced(_SMALL, prior="residual"),
    f"{SMALL}-window-3": replaced(_SMALL, window=3),
    f"{SMALL}-window-5": replaced(_SMALL, window=5),
}
KNOWN = (*MODELS, *(name for name in NETWORKS if name not in MODELS))
GRID = Grid(64)
SAME = "same world"
"""What is asked about: sequences of the dataset that was fitted on, but none of those."""
_SOURCES = {
    1: {"ideal": "ideal", "recovered": "recovered"},
    2: {"ideal": "motion-ideal", "recovered": "motion"},
}
_COMPONENTS = 200  # principal components of displacement
_BASIS = 150  # sequences that they are found on
_LEAST, _MOST = 4, 80  # epochs


@dataclass(frozen=True)
class Reader:
    """One point of a curve."""

    model: str
    input: str
    eyes: int
    size: int
    """Sequences fitted on: the first ones behind those that are asked and those that choose."""
    seed: int

    @property
    def slug(self) -> str:
        return f"{self.model}-{self.input}-{self.eyes}-{self.size}-{self.seed}"

    @property
    def fitted(self) -> str:
        """The clips' name of the displacement that it is fitted on; raises KeyError of none, as noise is."""
        return _SOURCES[self.eyes]["ideal" if self.input == EXACT else self.input]

    @property
    def asked(self) -> str:
        """The clips' name of the displacement that it is asked with."""
        return _SOURCES[self.eyes]["ideal" if self.input == EXACT else "recovered"]


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
        """Median over sequences: the first of a process compiles for all of them."""
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
        tests = {SAME: clips[: self.asked]}
        tests |= {root.name: _load(root, self.work) for root in self.unseen}
        used = [clip.content_hash for part in (fit, choose, *tests.values()) for clip in part]
        key = kept.word(__name__, asdict(one), self.steps, used)

        def compute() -> list[dict[str, Any]]:
            began = time.process_time()
            answer, predictor = self._fitted(one, fit, choose, key)
            spent = time.process_time() - began
            hours = (spent + one.size * self.generation_cpu_s()) / 3600
            return [
                asdict(one)
                | {"asked": name, "fit_cpu_s": round(spent, 1), "cpu_h": round(hours, 3)}
                | figures(answer, part, self._bare(name), size_only=one.model == BOOSTING)
                | (
                    {"map_r2": None, "ghosts": None}
                    if predictor is None
                    else map_figures(predictor, part, one.asked)
                )
                for name, part in tests.items()
            ]

        found: list[dict[str, Any]] = kept.result(self.work / "rows", one.slug, key, compute)
        return found

    def _bare(self, name: str) -> list[bool]:
        """Which of the sequences asked about have no membrane."""
        if name == SAME:
            return _bare(self.data)[: self.asked]
        return next(_bare(root) for root in self.unseen if root.name == name)

    def _fitted(
        self, one: Reader, fit: Sequence[Clip], choose: Sequence[Clip], key: str
    ) -> tuple[Answer, Predictor | None]:
        if one.model in NETWORKS:
            folder = self.work / "networks" / f"{one.slug}-{key}"
            predictor = _network(one, fit, choose, self.steps, folder)
            return partial(models.read_force, predictor, source=one.asked), predictor
        source = one.fitted
        if one.model == PHYSICS:
            return _by_half_space(one, fit, source), None
        if one.model == BOOSTING:
            rng = np.random.default_rng(one.seed)
            small = [coarse(clip) for clip in fit]
            rule = baselines.boosting(small, source, rng, Grid(GRID.size // 2))
            return partial(_by_frame, rule, one.asked), None
        return _by_components(one, fit, source), None


def _by_frame(rule: baselines.Rule, source: str, clip: Clip) -> Floats:
    """What a rule of single frames says of a clip, on half its grid."""
    small = coarse(clip)
    said = [rule(moved, small.mask, small.mask) for moved in small.displacement[source]]
    return clip.young_kpa * np.stack(said)


@cache
def _load(root: Path, work: Path) -> list[Clip]:
    wanted = [source for sources in _SOURCES.values() for source in sources.values()]
    return load_clips(root, GRID, wanted, cache=work / "clips")


@cache
def _generation_cpu_s(root: Path) -> float:
    timings = [one.attrs["timings"].values() for one in Dataset(root)]
    return float(np.median([sum(t["cpu_s"] for t in spent if isinstance(t, dict)) for spent in timings]))


@cache
def _bare(root: Path) -> list[bool]:
    return [not one.attrs["scenario"]["tissue"].get("membrane") for one in Dataset(root)]


def _by_half_space(one: Reader, fit: Sequence[Clip], source: str) -> Answer:
    """Tikhonov's tractions of a half-space, with one factor a component: held tissue moves less."""
    solver = HalfSpace()
    solver.set_units(1.0, GRID.extent_mm, 1.0)

    def solved(clip: Clip, source: str) -> Floats:
        moved = torch.from_numpy(np.array(clip.displacement[source]))
        mask = torch.from_numpy(np.array(clip.mask)).expand(len(moved), 1, -1, -1)
        with torch.no_grad():
            said = solver(moved, mask).sum((2, 3)).numpy() * GRID.pitch_mm**2
        return np.pad(said, ((0, 0), (0, 3 - said.shape[1])))  # one eye sees none along the view

    products = []
    for clip in fit:
        said, true = solved(clip, source), clip.force / clip.young_kpa
        products.append(np.array([said * true, said * said]).sum(1) / np.square(true).sum())
    both, own = np.sum(products, axis=0)
    factor = both / np.where(own > 0, own, 1.0)
    return lambda clip: clip.young_kpa * factor * solved(clip, one.asked)


def _by_components(one: Reader, fit: Sequence[Clip], source: str) -> Answer:
    """Ridge or nearest neighbours on principal components of displacement, in eight turns."""
    small = [coarse(clip) for clip in fit]
    # Not centred: no motion stays zero.
    x, _, _ = models.samples(small[:_BASIS], source)
    basis = TruncatedSVD(min(_COMPONENTS, min(x.shape) - 1), random_state=0).fit(x)
    features, forces, groups = [], [], []
    for start in range(0, len(small), _BASIS):
        x, force, group = models.samples(small[start : start + _BASIS], source)
        features.append(basis.transform(x))
        forces.append(force)
        groups.append(group + start)
    x, force, group = np.concatenate(features), np.concatenate(forces), np.concatenate(groups)
    regressor: Any = models.fit_ridge(x, force, group) if one.model == RIDGE else baselines.nearest(x, force)
    return lambda clip: (
        clip.young_kpa * np.asarray(regressor.predict(basis.transform(models.rows(coarse(clip), one.asked))))
    )


def network_settings(one: Reader, steps: int, frames: int) -> Settings:
    """Of a network's training: as many epochs as make up `steps` batches of the `frames` there are."""
    batch = 16
    epochs = int(np.clip(round(steps * batch / frames), _LEAST, _MOST))
    depth = one.eyes == 2
    given = {"noise": "recovered", EXACT: "ideal"}.get(one.input, one.input)
    names = {"ideal": "motion-ideal", "recovered": "motion", "mixed": "motion-mixed"}
    return Settings.model_validate(
        {
            "size": GRID.size,
            "arch": {**dict(NETWORKS[one.model]), "depth": depth},
            "objective": FRAMEWISE,
            "input": names[given] if depth else given,
            "epochs": epochs,
            "batch": batch,
            "learning_rate": 2e-3,
            "schedule": "cosine",
            "channels_last": True,
            "seed": one.seed,
        }
    )


def _network(one: Reader, fit: Sequence[Clip], choose: Sequence[Clip], steps: int, folder: Path) -> Predictor:
    settings = network_settings(one, steps, sum(clip.frames for clip in fit))
    clips = [*fit, *choose]
    if one.input == "noise":
        clips = noisy(clips, len(fit), one.seed)
    split = Split(tuple(range(len(fit))), tuple(range(len(fit), len(clips))), ())
    train(clips, split, settings, folder)
    return load_predictor(folder)


def noisy(clips: Sequence[Clip], fitted: int, seed: int) -> list[Clip]:
    """The clips with recovered flow replaced by true flow and the noise fitted on the first `fitted`."""
    known = clips[:fitted]
    noise = gap.fit_noise(
        [np.asarray(c.displacement["ideal"]) for c in known],
        [np.asarray(c.displacement["recovered"]) for c in known],
        [c.mask for c in known],
    )

    def spoilt(k: int, clip: Clip) -> Clip:
        made = noise.add(np.asarray(clip.displacement["ideal"]), clip.mask, np.random.default_rng([seed, k]))
        return replace(clip, displacement={**clip.displacement, "recovered": made})

    return [spoilt(k, clip) for k, clip in enumerate(clips)]


def figures(answer: Answer, part: Sequence[Clip], bare: Sequence[bool], *, size_only: bool) -> dict[str, Any]:
    """Errors of the force as parts of it, means over sequences with their intervals, and the gain.

    Args:
        answer: who is asked.
        part: what about.
        bare: which of them have no membrane.
        size_only: whether only the first component of an answer is one, and means the force's size.
    """
    said, true = [answer(clip) for clip in part], [clip.force for clip in part]
    sizes = [np.nan_to_num(s[:, 0]) if size_only else np.linalg.norm(s, axis=1) for s in said]
    own = [np.linalg.norm(force, axis=1) for force in true]
    found: dict[str, Sequence[float] | None] = {
        "force_size": [
            float(np.sqrt(np.square(a - b).mean() / np.square(b).mean()))
            for a, b in zip(sizes, own, strict=True)
        ],
        "whole": None,
        "across": None,
        "along": None,
        "bare": None,
    }
    if not size_only:
        off = errors(said, true)
        found |= {"whole": off["errors"], "across": off["across"], "along": off["along"]}
        found["bare"] = [e for e, alone in zip(off["errors"], bare, strict=True) if alone] or None
    row: dict[str, Any] = {}
    for name, values in found.items():
        mean = None if values is None else interval(np.array(values), np.random.default_rng(0))
        row |= {
            name: mean and round(mean.mean, 4),
            f"{name}_low": mean and round(mean.low, 4),
            f"{name}_high": mean and round(mean.high, 4),
        }
    all_said, all_true = np.concatenate(sizes), np.concatenate(own)
    # Whoever answers with the mean of what is possible says less than there is (a gain under 1), and what
    # there is, is on average what he says (a slope of 1): a gain is a fault only where the slope isn't 1.
    both = float(all_said @ all_true)
    row["gain"] = round(both / float(all_true @ all_true), 3)
    row["slope"] = round(both / max(float(all_said @ all_said), 1e-30), 3)
    return row


def map_figures(predictor: Predictor, part: Sequence[Clip], source: str) -> dict[str, Any]:
    """R² of the force map over all cells, and the share of contact-free area that says a force."""
    known = evaluate(predictor, part, source).summary()
    return {"map_r2": round(known["map_r2_pooled"], 4), "ghosts": round(known["ghost_relative"], 5)}
