"""Whole pipelines from physics to model: the sequences that each makes, and what it errs by."""

from __future__ import annotations

import functools
import shutil
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.methods.baselines import GRID
from evidence import cache
from evidence.end_to_end import models
from learn.data import clips as data
from learn.data.clips import Clip
from learn.data.grid import Grid, Resampler, centre
from synth.dataset import location
from synth.dataset.folder import write_whole
from synth.dataset.store import Sequence, open_sequence
from synth.flow import mask_detection
from synth.flow.estimator import Estimator, create
from synth.flow.track import track
from synth.job import identity
from synth.job.schema import FemSection, FlowSection, Job, RenderSection
from synth.sequence import pipeline

FRAMES, SIZE, VERTICES, LOAD, GESTURES = 8, (256, 192), 8000, (0.05, 0.2), ("pull", "push")
_MODELS = (models.RIDGE, models.NEAREST, models.PHYSICS)
_KEPT = ("peak_rss_mb", "store")
"""Of a sequence's timings, what is no cost of making it."""


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
    fem = FemSection(load=LOAD)
    return World(fem.chosen_law[0], fem.tets, RenderSection().spp)


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
    def default(self) -> bool:
        """Whether it is made of defaults alone; the model is none of a job's."""
        return self.world == default_world() and self.flow == FlowSection().backend

    def as_row(self) -> dict[str, Any]:
        """What names it in a row of results."""
        return asdict(self.world) | {"flow": self.flow, "model": self.model, "default": self.default}


def chosen() -> list[Pipeline]:
    """One thing changed at a time from the defaults, all at their cheapest, and as dear as what is asked."""
    usual, flow = default_world(), FlowSection().backend
    cheapest = World("linear", 400, 1)
    changed = [replace(usual, law="linear"), replace(usual, tets=400), replace(usual, spp=1)]
    worlds = dict.fromkeys([usual, *changed, cheapest, FINE])
    pairs = [(world, flow) for world in worlds]
    pairs += [(usual, other) for other in ("dis", "opencv-tvl1", "ideal")] + [(cheapest, "dis")]
    made = [Pipeline(world, flow, model) for world, flow in pairs for model in _MODELS]
    # Physics alone learns nothing from the sequences: it is one dot for every flow that it is asked with.
    return [p for p in made if p.model != models.PHYSICS or (p.world == usual and p.flow != "ideal")]


class Sequences:
    """Sequences of one world on the baselines' grid, with the flow that any estimator recovers from them.

    Costs are the least CPU time a frame of all sequences: what else runs on a machine only ever adds, and
    the first of a process compiles.
    """

    def __init__(self, world: World, job: Job, work: Path) -> None:
        """Renders what is not there yet."""
        self._job = job
        self._folder = work / f"{world.name}-{job.seed}-{cache.key(identity.identify_job(job))}"
        self._folder.mkdir(parents=True, exist_ok=True)
        for index in range(job.sequences):
            target = location.store(self._folder, index)
            if not target.exists():
                shutil.rmtree(target.with_suffix(".zarr.part"), ignore_errors=True)
                pipeline.render_sequence(job, index, self._folder, lambda stage, done, of: None)

    def clips(self, flow: str) -> list[Clip]:
        """The clips with `recovered` displacement of an estimator; kept beside the sequences."""
        return [
            cache.clip(self._folder / f"clips-{flow}" / f"{k:06d}", functools.partial(self._recover, k, flow))
            for k in range(self._job.sequences)
        ]

    def data_s(self) -> float:
        """CPU time [s] of making a frame, without its flow."""
        spent: list[float] = []
        for k in range(self._job.sequences):
            one = open_sequence(location.store(self._folder, k))
            times = one.attrs["timings"].items()
            spent.append(sum(t["cpu_s"] for stage, t in times if stage not in _KEPT) / one.frames)
        return min(spent)

    def flow_s(self, flow: str) -> float:
        """CPU time [s] of a frame's masks and flow; 0 of ideal flow. Of clips that are there."""
        if flow == "ideal":
            return 0.0
        return min(float(self._flow_cost(k, flow).read_text("utf-8")) for k in range(self._job.sequences))

    def _flow_cost(self, index: int, flow: str) -> Path:
        return self._folder / f"flow-{flow}-{index:06d}.cpu_s"

    def _recover(self, index: int, flow: str) -> Clip:
        sequence = open_sequence(location.store(self._folder, index))
        clip = data.read_clip(sequence, GRID, ("ideal",))
        if flow == "ideal":
            return replace(clip, displacement=clip.displacement | {"recovered": clip.displacement["ideal"]})
        began = time.process_time()
        hidden = mask_detection.hidden(sequence["rgb"][...], sequence["tool"][...].astype(bool))
        masks_s = time.process_time() - began
        recovered, flow_s = recover_flow(sequence, clip, create(flow), hidden, GRID)
        spent = (masks_s + flow_s) / (clip.frames - 1)
        write_whole(self._flow_cost(index, flow), str(spent), durable=False)
        return recovered


def errors(one: Pipeline, made: Sequences, asked: Sequences, work: Path) -> dict[str, Any]:
    """What a pipeline errs by, and CPU time [s] of an answer; one fitted on ideal flow is asked with the
    default's. Kept in `work`."""
    fit = [] if one.model == models.PHYSICS else made.clips(one.flow)
    tests = asked.clips(FlowSection().backend if one.flow == "ideal" else one.flow)

    def compute() -> dict[str, Any]:
        answer = models.build(one.model, fit)
        given, spent = [], []
        for clip in tests:
            began = time.process_time()
            given.append(answer(clip))
            spent.append((time.process_time() - began) / clip.frames)
        return models.errors(given, [clip.force for clip in tests]) | {"answer_s": min(spent)}

    key = cache.key(one.name, [clip.content_hash for clip in (*fit, *tests)])
    found: dict[str, Any] = cache.result(work / "answers", one.name.replace(", ", "-"), key, compute)
    return found


def recover_flow(
    sequence: Sequence, clip: Clip, estimator: str | Estimator, blocked: NDArray[np.bool_], grid: Grid
) -> tuple[Clip, float]:
    """The clip with the flow that an estimator recovers, and the CPU time of the flow over all frames [s].

    Args:
        sequence: rendered, with `rgb` and `tissue`.
        clip: of the sequence on `grid`.
        estimator: or its name.
        blocked: (T, H, W) what is masked: tool, glare.
        grid: of the clip.
    """
    tissue = sequence["tissue"][:].astype(bool)
    scale = float(sequence.attrs["scale_mm_per_px"])
    resample = Resampler((tissue.shape[0], tissue.shape[1]), scale, centre(tissue), grid)
    moved, confidence = np.zeros_like(clip.displacement["ideal"]), np.ones_like(clip.confidence)
    rgb, began = sequence["rgb"][: clip.frames], time.process_time()
    followed = track(estimator, rgb, blocked[: clip.frames], tissue)
    spent = time.process_time() - began
    for t in range(1, clip.frames):
        moved[t] = resample.mean(followed.flow[t].transpose(2, 0, 1) * scale, tissue) * clip.mask
        confidence[t] = resample.mean(followed.confidence[t], tissue) * clip.mask
    found = {**clip.displacement, "recovered": moved}
    return replace(clip, displacement=found, confidence=confidence), spent
