"""`bench pareto end-to-end`: error of the force against cost, for whole pipelines from physics to model.

A pipeline makes sequences (law, mesh, paths), recovers their flow and fits a model on them; it is asked for
the force of sequences that a finer pipeline made of scenes it has not seen, from the flow that its own
estimator recovers there. Its cost is the CPU time of one frame of its data and of one answer.

What is asked is restricted to one instrument that pulls or pushes: flow shows the force along the line of
sight only through the little that tissue spreads under a push, and a grasp's two jaws gather it as well. On
recovered flow hardly anything of that part is learnt (`along` in the results): so the part across the line of
sight is judged by itself besides.
"""

from __future__ import annotations

import hashlib
import json as json_
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from bench.methods.baselines import GRID
from bench.output import machine, write
from evidence.end_to_end import costs as end_to_end_costs
from evidence.end_to_end import models, page
from evidence.end_to_end.models import Answer
from evidence.gap.recompute_flow import refollow
from evidence.measuring import measuring
from learn.data import clips as data
from learn.data.clips import Clip
from learn.evaluation.statistics import interval, paired
from synth.dataset import location, provenance
from synth.dataset.store import open_sequence
from synth.flow import mask
from synth.job import identity
from synth.job.law_limits import choose
from synth.job.schema import Fem, Flow, Job, Render
from synth.sequence import pipeline

Floats = NDArray[np.float64]

FRAMES, SIZE, VERTICES, LOAD, GESTURES = 8, (256, 192), 8000, (0.05, 0.2), ("pull", "push")
_MODELS = (models.RIDGE, models.NEAREST, models.PHYSICS)


PARTS = {"": "errors", "across_": "across"}
"""What defaults are judged by: the whole force, and its part across the line of sight. Prefix of the names in
a row, and the errors by sequence."""


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


@measuring("--fit 8 --test 6 --out runs/end-to-end")
def pareto(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results.")] = Path(
        "docs/results/end-to-end"
    ),
    work: Annotated[
        Path,
        typer.Option(
            help="Folder for sequences, flow and answers; what is there already is used, if the same job, "
            "generator and estimator made it."
        ),
    ] = Path("runs/end-to-end-work"),
    fit: Annotated[int, typer.Option(min=4, help="Sequences that each pipeline makes to fit on.")] = 40,
    test: Annotated[int, typer.Option(min=3, help="Sequences that all are asked about.")] = 24,
    seed: Annotated[int, typer.Option(min=0, help="Root of every draw.")] = 31,
    epochs: Annotated[int, typer.Option(min=1, help="Of the network.")] = 60,
    rounds: Annotated[
        int, typer.Option(min=2, help="How often everything is timed, in turn, once the answers are there.")
    ] = 4,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Error of the force against CPU time a frame, for whole pipelines: law, mesh, paths, flow and model."""

    def say(line: str) -> None:
        if not json:
            typer.echo(line)

    asked = Made(FINE, FINE.job(seed + 1, test), work)
    pipelines = chosen()
    worlds = dict.fromkeys(one.world for one in pipelines)
    made = {world: Made(world, world.job(seed, fit), work) for world in worlds}
    sources = _word([asked.name, *(one.name for one in made.values())])
    run = work / f"answers-{fit}-{test}-{seed}-{epochs}-{sources}"
    rows: list[dict[str, Any]] = []
    for one in pipelines:
        rows.append(one.words() | answered(one, made[one.world], asked, run, epochs, seed))
        say(f"{len(rows)} of {len(pipelines)}: {one.name}, {100 * np.mean(rows[-1]['errors']):.0f}%")
    usual = [one for one in pipelines if one.default]
    ready = {one.model: _answer(one, made[one.world], run, epochs, seed) for one in usual}
    costs = end_to_end_costs.measure(
        {world.name: world.job(seed, fit) for world in made},
        [flow for flow in dict.fromkeys(one.flow for one in pipelines) if flow != "ideal"],
        ready,
        asked.clips(Flow().backend),
        work,
        rounds,
        say,
    )
    for one, row in zip(pipelines, rows, strict=True):
        row |= {"data_s": costs.data[one.world.name], "flow_s": costs.flow[one.flow]}
        row |= {"answer_s": costs.answer[one.model]}
        row["cpu_s"] = row["data_s"] + row["flow_s"] + row["answer_s"]
    still = [clip.force for clip in asked.clips("ideal")]
    nothing = {key: float(np.mean(v)) for key, v in errors([0 * f for f in still], still).items()}
    found = {
        "command": f"bench pareto end-to-end --fit {fit} --test {test} --seed {seed} --epochs {epochs} "
        f"--rounds {rounds}",
        "machine": machine.describe(),
        "meaning": f"{SIZE[0]} x {SIZE[1]} px, {FRAMES} frames, one instrument that pulls or pushes; "
        "cpu_s: of a frame of data (physics, scene, rendering, flow) and of one answer, the least of "
        f"{rounds} rounds in which everything was timed in turn; errors: of the force's three components "
        "together, root mean square over frames as a part of the force's own, by sequence; across, along: "
        "the parts of it across and along the line of sight, whose squares add up in every sequence",
        "asked": asdict(FINE),
        "zero": nothing["errors"],
        "across_zero": nothing["across"],
        "rows": summarised(rows, seed),
        "rounds": costs.rounds,
    }
    write.keep(out, "pareto.json", found)
    page.write(found, out)
    typer.echo(json_.dumps(found) if json else str(out / "index.html"))


def summarised(rows: list[dict[str, Any]], seed: int) -> list[dict[str, Any]]:
    """Rows with means over sequences and what they err more than the default pipeline with the same model.

    `rmse`, `low`, `high` of the whole force, and of its part across as `across_rmse` and so on, BCa;
    `difference` and `across_difference`: mean, low, high; None for a default.
    """
    defaults = {row["model"]: row for row in rows if row["default"]}
    done = []
    for row in rows:
        usual = None if row["default"] else defaults[row["model"]]
        more: dict[str, Any] = {"along_rmse": float(np.mean(row["along"]))}
        for name, part in PARTS.items():
            found = interval(np.asarray(row[part]), np.random.default_rng(seed))
            more |= {f"{name}rmse": found.mean, f"{name}low": found.low, f"{name}high": found.high}
            more[f"{name}difference"] = None if usual is None else difference(usual[part], row[part], seed)
        done.append(row | more)
    return done


def difference(usual: list[float], other: list[float], seed: int) -> list[float]:
    """Mean, low and high of what `other` errs more than `usual` on the same sequences (BCa)."""
    found = paired(np.asarray(usual), np.asarray(other), np.random.default_rng(seed)).difference
    return [found.mean, found.low, found.high]


def called(world: World, job: Job) -> str:
    """Folder of a world's sequences: another one when the job's constants or the generator's code change."""
    return f"{world.name}-{job.seed}-{_word([identity.of(job), provenance.fingerprint()])}"


def _word(value: Any) -> str:
    return hashlib.blake2b(identity.canonical(value), digest_size=5).hexdigest()


class Made:
    """Sequences of one world on the baselines' grid, with the flow that any estimator recovers from them."""

    def __init__(self, world: World, job: Job, work: Path) -> None:
        """Renders what is not there yet."""
        self.world, self._job = world, job
        self.name = called(world, job)
        self._folder = work / self.name
        self._folder.mkdir(parents=True, exist_ok=True)
        for index in range(job.sequences):
            target = location.store(self._folder, index)
            if not target.exists():
                shutil.rmtree(target.with_suffix(".zarr.part"), ignore_errors=True)
                pipeline.render_sequence(job, index, self._folder, lambda stage, done, of: None)

    def clips(self, flow: str) -> list[Clip]:
        """The clips with `recovered` displacement of an estimator; kept beside the sequences."""
        return [self._clip(index, flow) for index in range(self._job.sequences)]

    def _clip(self, index: int, flow: str) -> Clip:
        kept = self._folder / f"clips-{GRID.size}" / self._estimator(flow) / f"{index:06d}"
        if not kept.is_dir():
            data.pack(self._followed(index, flow), kept)
        return data.unpack(kept)

    def _flow(self, backend: str) -> Flow:
        return self._job.flow.model_copy(update={"backend": backend})

    def _estimator(self, flow: str) -> str:
        """An estimator and its settings in a folder's name; its code is in the generator's fingerprint."""
        return f"{flow}-{_word(self._flow(flow).model_dump(mode='json'))}"

    def _followed(self, index: int, flow: str) -> Clip:
        sequence = open_sequence(location.store(self._folder, index))
        clip = data.read(sequence, GRID, ("ideal",))
        if flow == "ideal":
            return replace(clip, displacement=clip.displacement | {"recovered": clip.displacement["ideal"]})
        estimator = pipeline.estimator(self._flow(flow))
        hidden = mask.hidden(sequence["rgb"][...], sequence["tool"][...].astype(bool))
        return refollow(sequence, clip, estimator, hidden, GRID)[0]


def answered(
    one: Pipeline, made: Made, asked: Made, folder: Path, epochs: int, seed: int
) -> dict[str, list[float]]:
    """Errors of one pipeline, kept in `folder`; one fitted on ideal flow is asked with the default's."""
    kept = folder / f"{one.slug}.json"
    if kept.exists():
        known: dict[str, list[float]] = json_.loads(kept.read_text("utf-8"))
        return known
    answer = _answer(one, made, folder, epochs, seed)
    tests = asked.clips(Flow().backend if one.flow == "ideal" else one.flow)
    found = errors([answer(clip) for clip in tests], [clip.force for clip in tests])
    write.keep(folder, kept.name, found)
    return found


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


def _answer(one: Pipeline, made: Made, folder: Path, epochs: int, seed: int) -> Answer:
    fit = [] if one.model in models.UNLEARNT else made.clips(one.flow)
    return models.build(one.model, fit, folder / f"network-{one.slug}", epochs, seed)
