"""`bench pareto end-to-end`: error of the force against cost, for whole pipelines from physics to model.

A pipeline makes sequences (law, mesh, paths), recovers their flow and fits a model on them; it is asked for
the force of sequences that a finer pipeline made of scenes it has not seen, from the flow that its own
estimator recovers there. Its cost is the CPU time of one frame of its data and of one answer.
"""

from __future__ import annotations

import json as json_
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from bench import baseline, end_to_end_page, machine
from bench.baseline import GRID
from bench.refollow import refollow
from learn import data
from learn.data import Clip
from learn.statistics import interval
from synth import pipeline, place
from synth.fem.validity import choose
from synth.flow import mask
from synth.job import Fem, Flow, Job, Render
from synth.store import Sequence, open_sequence

Floats = NDArray[np.float64]

FRAMES, SIZE, VERTICES, LOAD = 8, (256, 192), 8000, (0.05, 0.2)
NETWORK = "D2FNet tiny"
_MODELS = ("ridge on PCA of flow", "k-NN on PCA of flow", "Tikhonov near the contact")
_UNLEARNT = ("Tikhonov near the contact",)


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
                "fem": {"law": self.law, "tets": self.tets, "load": LOAD},
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
    return World(choose(fem.law, fem.largest_load, fem.tolerance)[0], fem.tets, Render().spp)


FINE = World("neo-hookean", 3000, 8)
"""Makes the sequences that all are asked about."""


@dataclass(frozen=True)
class Pipeline:
    """One dot of the chart."""

    world: World
    flow: str
    model: str

    @property
    def default(self) -> bool:
        """Whether it is made of defaults alone; the model is none of a job's."""
        return self.world == default_world() and self.flow == Flow().backend


def chosen() -> list[Pipeline]:
    """One thing changed at a time from the defaults, and all of them at their cheapest."""
    usual, flow = default_world(), Flow().backend
    worlds = [
        usual,
        replace(usual, law="linear"),
        replace(usual, tets=400),
        replace(usual, spp=1),
        World("linear", 400, 1),
    ]
    cheapest = worlds[-1]
    made = [Pipeline(world, flow, model) for world in dict.fromkeys(worlds) for model in _MODELS]
    made += [Pipeline(usual, other, m) for other in ("dis", "opencv-tvl1", "ideal") for m in _MODELS]
    made += [Pipeline(cheapest, "dis", model) for model in _MODELS]
    made += [Pipeline(world, flow, NETWORK) for world in (usual, cheapest)]
    made += [Pipeline(usual, other, NETWORK) for other in ("dis", "ideal")]
    # Physics alone learns nothing from the sequences: it is one dot for every flow.
    return [p for p in made if p.model not in _UNLEARNT or p.world == usual]


def pareto(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results.")] = Path(
        "docs/results/end-to-end"
    ),
    work: Annotated[
        Path, typer.Option(help="Folder for the sequences; what is there already is used.")
    ] = Path("end-to-end-work"),
    fit: Annotated[int, typer.Option(min=4, help="Sequences that each pipeline makes to fit on.")] = 14,
    test: Annotated[int, typer.Option(min=3, help="Sequences that all are asked about.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Root of every draw.")] = 31,
    epochs: Annotated[int, typer.Option(min=1, help="Of the network.")] = 30,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Error of the force against CPU time a frame, for whole pipelines: law, mesh, paths, flow and model."""
    asked = Made(FINE, FINE.job(seed + 1, test), work)
    kept: dict[str, Made] = {}
    rows: list[dict[str, Any]] = []
    found: dict[str, Any] = {
        "command": f"bench pareto end-to-end --fit {fit} --test {test} --seed {seed} --epochs {epochs}",
        "machine": machine.describe(),
        "meaning": f"{SIZE[0]} x {SIZE[1]} px, {FRAMES} frames; cpu_s: of a frame of data (physics, scene, "
        "rendering, flow) and of one answer; rmse: of the force's three components together, as a part of "
        "its root mean square in the sequence, mean over sequences with its BCa interval",
        "asked": asdict(FINE),
        "missing": [f"{p.world.name}, {p.flow}, {p.model}" for p in chosen()],
        "rows": rows,
    }
    for one in chosen():
        made = kept.setdefault(one.world.name, Made(one.world, one.world.job(seed, fit), work))
        row = measure(one, made, asked, work, epochs, seed)
        rows.append(asdict(one.world) | {"flow": one.flow, "model": one.model, "default": one.default} | row)
        found["missing"] = found["missing"][1:]
        if not json:
            typer.echo(
                f"{one.world.name:22s} {one.flow:12s} {one.model:26s} {row['cpu_s']:.3f} CPU-s a frame  "
                f"{100 * row['rmse']:.0f}% [{100 * row['low']:.0f}, {100 * row['high']:.0f}]"
            )
        out.mkdir(parents=True, exist_ok=True)
        (out / "pareto.json").write_text(json_.dumps(found, indent=1) + "\n", "utf-8")
    end_to_end_page.write(found, out)
    if json:
        typer.echo(json_.dumps(found))


class Made:
    """Sequences of one world on the baselines' grid, with the flow that any estimator recovers from them."""

    def __init__(self, world: World, job: Job, work: Path) -> None:
        """Renders what is not there yet."""
        self.world, self._job = world, job
        folder = work / f"{world.name}-{job.seed}"
        folder.mkdir(parents=True, exist_ok=True)
        for index in range(job.sequences):
            target = place.store(folder, index)
            if not target.exists():
                shutil.rmtree(target.with_suffix(".zarr.part"), ignore_errors=True)
                pipeline.render_sequence(job, index, folder, lambda stage, done, of: None)
        self.sequences = [open_sequence(place.store(folder, index)) for index in range(job.sequences)]
        # The first one of a process compiles: medians leave it out.
        costs = [
            sum(t["cpu_s"] for name, t in s.attrs["timings"].items() if name not in ("peak_rss_mb", "store"))
            for s in self.sequences
        ]
        self.cpu_s = float(np.median(costs)) / FRAMES
        self._clips = [data.read(s, GRID, ("ideal",)) for s in self.sequences]
        self._flows: dict[str, tuple[list[Clip], float]] = {}

    def clips(self, flow: str) -> tuple[list[Clip], float]:
        """The clips with `recovered` displacement of an estimator, and its CPU-s a frame."""
        if flow not in self._flows:
            if flow == "ideal":
                same = [
                    replace(c, displacement={**c.displacement, "recovered": c.displacement["ideal"]})
                    for c in self._clips
                ]
                self._flows[flow] = (same, 0.0)
            else:
                pairs = [self._followed(s, c, flow) for s, c in zip(self.sequences, self._clips, strict=True)]
                self._flows[flow] = ([c for c, _ in pairs], float(np.median([t for _, t in pairs])))
        return self._flows[flow]

    def _followed(self, sequence: Sequence, clip: Clip, flow: str) -> tuple[Clip, float]:
        rgb, tools = sequence["rgb"][...], sequence["tool"][...].astype(bool)
        began = time.process_time()
        blocked = tools | np.stack([mask.glare(picture) for picture in rgb])
        masks_s = time.process_time() - began
        job = self._job.flow.model_copy(update={"backend": flow})
        found, flow_s = refollow(sequence, clip, pipeline.estimator(job), blocked, GRID)
        return found, (masks_s + flow_s) / (clip.frames - 1)


def measure(one: Pipeline, made: Made, asked: Made, work: Path, epochs: int, seed: int) -> dict[str, Any]:
    """Error and cost of one pipeline; trained on ideal flow, it is asked with the default estimator's."""
    fit, flow_s = made.clips(one.flow)
    tests, _ = asked.clips(Flow().backend if one.flow == "ideal" else one.flow)
    began = time.process_time()
    answer = _network(one, fit, work, epochs, seed) if one.model == NETWORK else _rule(one, fit)
    train_s = time.process_time() - began
    began, errors = time.process_time(), []
    for clip in tests:
        said = answer(clip)
        off = np.square(said - clip.force).sum(axis=1).mean()
        errors.append(float(np.sqrt(off / np.square(clip.force).sum(axis=1).mean())))
    answer_s = (time.process_time() - began) / sum(clip.frames for clip in tests)
    found = interval(np.asarray(errors), np.random.default_rng(seed))
    return {
        "cpu_s": made.cpu_s + flow_s + answer_s,
        "data_s": made.cpu_s,
        "flow_s": flow_s,
        "answer_s": answer_s,
        "train_s": train_s,
        "rmse": found.mean,
        "low": found.low,
        "high": found.high,
        "errors": errors,
    }


def _rule(one: Pipeline, fit: list[Clip]) -> Callable[[Clip], Floats]:
    known = baseline.physical_rules() if one.model in _UNLEARNT else baseline.fitted_rules(fit, "recovered")
    rule = known[one.model]

    def answer(clip: Clip) -> Floats:
        moved, sure = clip.displacement["recovered"], clip.confidence
        return clip.young_kpa * np.stack([rule(moved[t], clip.mask, sure[t]) for t in range(clip.frames)])

    return answer


def _network(one: Pipeline, fit: list[Clip], work: Path, epochs: int, seed: int) -> Callable[[Clip], Floats]:
    from learn.predict import load
    from learn.settings import preset
    from learn.split import Split
    from learn.train import train

    select = max(2, len(fit) // 5)
    settings = preset("tiny", size=GRID.size, epochs=epochs, input="recovered", seed=seed)
    split = Split(tuple(range(select, len(fit))), tuple(range(select)), ())
    folder = work / f"network-{one.world.name}-{one.flow}-{epochs}"
    train(fit, split, settings, folder)
    predictor = load(folder)

    def answer(clip: Clip) -> Floats:
        said, _ = predictor.answer(
            np.asarray(clip.displacement["recovered"]), clip.mask, clip.young_kpa, np.asarray(clip.confidence)
        )
        return np.asarray(said.sum(axis=(2, 3)) * GRID.pitch_mm**2, np.float64)

    return answer
