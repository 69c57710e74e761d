"""Whole pipelines from physics to model: what each makes, and what it errs by, kept by what made it."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.methods.baselines import GRID
from evidence import kept
from evidence.end_to_end import models
from evidence.end_to_end.models import Answer
from evidence.gap.recompute_flow import recover_flow
from learn.data import clips as data
from learn.data.clips import Clip
from synth.dataset import location, provenance
from synth.dataset.store import open_sequence
from synth.flow import mask
from synth.job import identity
from synth.job.schema import Fem, Flow, Job, Render
from synth.sequence import pipeline

Floats = NDArray[np.float64]

FRAMES, SIZE, VERTICES, LOAD, GESTURES = 8, (256, 192), 8000, (0.05, 0.2), ("pull", "push")
_MODELS = (models.RIDGE, models.NEAREST, models.PHYSICS)


@dataclass(frozen=True)
class World:
    """How sequences are made."""

    law: str
    tets: int
    spp: int

    def job(self, seed: int, count: int) -> Job:
        return Job.model_validate(
            {
                "seed": seed,
                "sequences": count,
                "frames": FRAMES,
                "anatomy": {"vertices": VERTICES},
                "fem": {"law": self.law, "tets": self.tets, "load": LOAD, "gestures": GESTURES},
                "render": {"size": SIZE, "spp": self.spp},
                "flow": {"backend": "ideal"},
            }
        )

    @property
    def name(self) -> str:
        return f"{self.law}-{self.tets}-{self.spp}"


def default_world() -> World:
    """What a job without these keys gets at this load."""
    fem = Fem(load=LOAD)
    return World(fem.chosen_law[0], fem.tets, Render().spp)


FINE = World("neo-hookean", 3000, 8)
"""Makes the sequences that all are asked about."""


@dataclass(frozen=True)
class Pipeline:
    """One dot of the chart."""

    world: World
    flow: str
    model: str

    @property
    def name(self) -> str:
        return f"{self.world.name}, {self.flow}, {self.model}"

    @property
    def slug(self) -> str:
        """Its name in a file's."""
        return self.name.replace(", ", "-").replace(" ", "-")

    def words(self) -> dict[str, Any]:
        """What names it in a row of results."""
        return asdict(self.world) | {"flow": self.flow, "model": self.model, "default": self.default}

    @property
    def default(self) -> bool:
        """Whether it is made of defaults alone; the model is none of a job's."""
        return self.world == default_world() and self.flow == Flow().backend


def chosen() -> list[Pipeline]:
    """One thing changed at a time from the defaults, all at their cheapest, and as dear as what is asked."""
    usual, flow = default_world(), Flow().backend
    cheapest = World("linear", 400, 1)
    worlds = [
        usual,
        replace(usual, law="linear"),
        replace(usual, tets=400),
        replace(usual, spp=1),
        cheapest,
        FINE,
    ]
    made = [Pipeline(world, flow, model) for world in dict.fromkeys(worlds) for model in _MODELS]
    made += [Pipeline(usual, other, m) for other in ("dis", "opencv-tvl1", "ideal") for m in _MODELS]
    made += [Pipeline(cheapest, "dis", model) for model in _MODELS]
    made += [Pipeline(world, flow, models.NETWORK) for world in (usual, cheapest)]
    made.append(Pipeline(usual, "ideal", models.NETWORK))
    # Physics alone learns nothing from the sequences: it is one dot for every flow that it is asked with.
    return [p for p in made if p.model not in models.UNLEARNT or (p.world == usual and p.flow != "ideal")]


def folder_name(world: World, job: Job) -> str:
    """Folder of a world's sequences: another one when the job's constants or the generator's code change."""
    return f"{world.name}-{job.seed}-{identity.identify_job(job)[:10]}-{provenance.fingerprint()}"


class Sequences:
    """Sequences of one world on the baselines' grid, with the flow that any estimator recovers from them."""

    def __init__(self, world: World, job: Job, work: Path) -> None:
        """Renders what is not there yet."""
        self._job = job
        self.name = folder_name(world, job)
        self._folder = work / self.name
        self._folder.mkdir(parents=True, exist_ok=True)
        for index in range(job.sequences):
            target = location.store(self._folder, index)
            if not target.exists():
                shutil.rmtree(target.with_suffix(".zarr.part"), ignore_errors=True)
                pipeline.render_sequence(job, index, self._folder, lambda stage, done, of: None)

    def clips(self, flow: str) -> list[Clip]:
        """The clips with `recovered` displacement of an estimator; kept beside the sequences."""
        settings = self._job.flow.model_copy(update={"backend": flow})
        key = kept.word(recover_flow.__module__, settings.model_dump(mode="json"), GRID.size, GRID.extent_mm)
        folder = self._folder / f"clips-{flow}-{key}"
        return [
            kept.clip(folder / f"{index:06d}", functools.partial(self._recover, index, settings))
            for index in range(self._job.sequences)
        ]

    def _recover(self, index: int, flow: Flow) -> Clip:
        sequence = open_sequence(location.store(self._folder, index))
        clip = data.read_clip(sequence, GRID, ("ideal",))
        if flow.backend == "ideal":
            return replace(clip, displacement=clip.displacement | {"recovered": clip.displacement["ideal"]})
        hidden = mask.hidden(sequence["rgb"][...], sequence["tool"][...].astype(bool))
        return recover_flow(sequence, clip, pipeline.estimator(flow), hidden, GRID)[0]


@dataclass(frozen=True)
class Trial:
    """How pipelines are fitted, and where what they learnt and said stays."""

    epochs: int
    """Of the network."""
    seed: int
    work: Path

    def fit(self, one: Pipeline, made: Sequences) -> Answer:
        """The pipeline's model, fitted on its sequences."""
        clips = _fitted_on(one, made)
        folder = self.work / "networks" / f"{one.slug}-{self._key(one, clips)}"
        return models.build(one.model, clips, folder, self.epochs, self.seed)

    def errors(self, one: Pipeline, made: Sequences, asked: Sequences) -> dict[str, list[float]]:
        """What the pipeline errs by; one fitted on ideal flow is asked with the default's."""
        tests = asked.clips(Flow().backend if one.flow == "ideal" else one.flow)

        def compute() -> dict[str, list[float]]:
            answer = self.fit(one, made)
            return errors([answer(clip) for clip in tests], [clip.force for clip in tests])

        key = self._key(one, [*_fitted_on(one, made), *tests])
        found: dict[str, list[float]] = kept.result(self.work / "answers", one.slug, key, compute)
        return found

    def _key(self, one: Pipeline, clips: Sequence[Clip]) -> str:
        settings = models.network_settings(self.epochs, self.seed).as_dict()
        return kept.word(__name__, one.name, settings, [clip.content_hash for clip in clips])


def _fitted_on(one: Pipeline, made: Sequences) -> list[Clip]:
    return [] if one.model in models.UNLEARNT else made.clips(one.flow)


def errors(said: Sequence[Floats], true: Sequence[Floats]) -> dict[str, list[float]]:
    """Root mean square error of the force as a part of the force's own, by sequence: (T, 3) mN, camera axes.

    Whole, and its parts across and along the line of sight.
    """
    found: dict[str, list[float]] = {"errors": [], "across": [], "along": []}
    for answer, force in zip(said, true, strict=True):
        own = np.square(force).sum(axis=1).mean()
        off = np.square(answer - force).mean(axis=0) / own
        for name, parts in (("errors", off), ("across", off[:2]), ("along", off[2:])):
            found[name].append(float(np.sqrt(parts.sum())))
    return found
