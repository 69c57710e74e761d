"""Whole pipelines from physics to model: the sequences that each makes, and its errors."""

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
from learn.data.grid import Grid, GridView
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
_NO_COST = ("peak_rss_mb", "store")  # timings of a sequence that are not costs of making it


@dataclass(frozen=True)
class Rendering:
    """Settings by which sequences are made."""

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


def default_rendering() -> Rendering:
    """Defaults of a job at this load."""
    fem = FemSection(load=LOAD)
    return Rendering(fem.chosen_law[0], fem.tets, RenderSection().spp)


FINE = Rendering("neo-hookean", 3000, 8)  # of the sequences that all pipelines are tested on


@dataclass(frozen=True)
class Pipeline:
    """One dot of the chart."""

    rendering: Rendering
    flow: str
    model: str

    @property
    def name(self) -> str:
        return f"{self.rendering.name}, {self.flow}, {self.model}"

    @property
    def default(self) -> bool:
        """Whether rendering and flow are the defaults; a job doesn't specify the model."""
        return self.rendering == default_rendering() and self.flow == FlowSection().backend

    def as_row(self) -> dict[str, Any]:
        """Settings that identify it in a row of results."""
        return asdict(self.rendering) | {"flow": self.flow, "model": self.model, "default": self.default}


def chosen() -> list[Pipeline]:
    """Defaults, changes of one setting at a time, all settings at their cheapest, and those of `FINE`."""
    usual, flow = default_rendering(), FlowSection().backend
    cheapest = Rendering("linear", 400, 1)
    changed = [replace(usual, law="linear"), replace(usual, tets=400), replace(usual, spp=1)]
    pairs = [(rendering, flow) for rendering in dict.fromkeys([usual, *changed, cheapest, FINE])]
    pairs += [(usual, other) for other in ("dis", "opencv-tvl1", "ideal")] + [(cheapest, "dis")]
    made = [Pipeline(rendering, flow, model) for rendering, flow in pairs for model in _MODELS]
    # Physics alone is not fitted: one dot for each flow estimator of the tested sequences.
    return [p for p in made if p.model != models.PHYSICS or (p.rendering == usual and p.flow != "ideal")]


class Sequences:
    """Sequences of one rendering on the baselines' grid, with the flow that any estimator recovers from them.

    Costs are the least CPU time a frame of all sequences: other processes only add to it, and the first
    sequence of a process includes compilation.
    """

    def __init__(self, rendering: Rendering, job: Job, work: Path) -> None:
        """Renders the sequences that are missing."""
        self._job = job
        self._folder = work / f"{rendering.name}-{job.seed}-{cache.key(identity.identify_job(job))}"
        self._folder.mkdir(parents=True, exist_ok=True)
        for index in range(job.sequences):
            target = location.store(self._folder, index)
            if not target.exists():
                shutil.rmtree(target.with_suffix(".zarr.part"), ignore_errors=True)
                pipeline.render_sequence(job, index, self._folder, lambda stage, done, of: None)

    def clips(self, flow: str) -> list[Clip]:
        """Clips with the `recovered` displacement of an estimator, stored next to the sequences."""
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
            spent.append(sum(t["cpu_s"] for stage, t in times if stage not in _NO_COST) / one.frames)
        return min(spent)

    def flow_s(self, flow: str) -> float:
        """CPU time [s] of a frame's masks and flow, 0 for ideal flow; requires `clips` first."""
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


def errors(one: Pipeline, made: Sequences, tested: Sequences, work: Path) -> dict[str, Any]:
    """Errors of a pipeline and CPU time of an estimate [s], cached in `work`.

    A pipeline fitted on ideal flow is tested with the default's flow.
    """
    fit = [] if one.model == models.PHYSICS else made.clips(one.flow)
    tests = tested.clips(FlowSection().backend if one.flow == "ideal" else one.flow)

    def compute() -> dict[str, Any]:
        estimate = models.build(one.model, fit)
        forces, spent = [], []
        for clip in tests:
            began = time.process_time()
            forces.append(estimate(clip))
            spent.append((time.process_time() - began) / clip.frames)
        return models.errors(forces, [clip.force for clip in tests]) | {"estimate_s": min(spent)}

    key = cache.key(one.name, [clip.content_hash for clip in (*fit, *tests)])
    found: dict[str, Any] = cache.result(work / "estimates", one.name.replace(", ", "-"), key, compute)
    return found


def recover_flow(
    sequence: Sequence, clip: Clip, estimator: str | Estimator, blocked: NDArray[np.bool_], grid: Grid
) -> tuple[Clip, float]:
    """Clip with the recovered flow of its rendered sequence, and the CPU time of all frames' flow [s].

    `blocked`: (T, H, W) masked pixels: tool, specular highlights.
    """
    tissue = sequence["tissue"][:].astype(bool)
    scale = float(sequence.attrs["scale_mm_per_px"])
    view = GridView(tissue, scale, grid)
    moved, confidence = np.zeros_like(clip.displacement["ideal"]), np.ones_like(clip.confidence)
    rgb, began = sequence["rgb"][: clip.frames], time.process_time()
    followed = track(estimator, rgb, blocked[: clip.frames], tissue)
    spent = time.process_time() - began
    for t in range(1, clip.frames):
        moved[t] = view.mean(followed.flow[t].transpose(2, 0, 1) * scale) * clip.mask
        confidence[t] = view.mean(followed.confidence[t]) * clip.mask
    found = {**clip.displacement, "recovered": moved}
    return replace(clip, displacement=found, confidence=confidence), spent
