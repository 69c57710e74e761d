"""What learn's choices are worth: folds, losses, controls, on labels-only and on rendered sequences."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from evidence.learn import run_table
from evidence.learn.labels import clips as labels
from evidence.learn.labels import press
from evidence.learn.runs import Run, carry_out
from evidence.learn.summary import write
from evidence.measuring import measuring
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid
from learn.loss import GHOSTLESS, Objective
from learn.network.d2fnet import Architecture
from learn.settings import Settings, preset, replace
from learn.training.threads import set_threads
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Job

RESULTS = Path("docs/results/learn")


LARGE = 1500
"""Sequences of `--large`: five times as many as the job says, its own the first of them."""


def small() -> Settings:
    """The study's base run: about a core-minute, the same for every choice that is compared."""
    base = preset("tiny", epochs=8, folds=3, objective=Objective(kind="mse"))
    return replace(base, arch=replace(base.arch, output="magnitude"))


PRESSED = ("long-fold0-seed0", "film-fold0-seed0")
"""Runs that are also scored with E from a calibration press."""
LOSSES = {
    "mse": Objective(kind="mse"),
    "ghostless": GHOSTLESS,
    "capped": Objective(kind="hinge", r2_scope="frame", stray_weight=10.0, stray_cap=0.1),
    "published": Objective(kind="published", rule="frame"),
    "antighost": Objective(),
    "antighost-frame": Objective(rule="frame"),
    "hinge": Objective(kind="hinge"),
    "r2-frame": replace(GHOSTLESS, stray_weight=0.0),
}
"""`antighost` and `antighost-frame` differ in the low-force rule alone. Which part of `ghostless` does what:
`hinge` has R² over the batch, as published, at its weight there, and `r2-frame` is without the price."""


def ideal_runs() -> Iterator[Run]:
    """On labels-only sequences, in the order of their worth; an interrupted study goes on where it was."""
    base = small()
    for seed in range(3):
        for name in ("mse", "ghostless", "published"):
            yield Run(f"{name}-fold0-seed{seed}", replace(base, objective=LOSSES[name], seed=seed))
    yield Run("shuffled-fold0-seed0", replace(base, epochs=4), control="shuffled")
    for name, arch in shapes(base.arch).items():
        yield Run(f"{name}-fold0-seed0", replace(base, arch=arch))
    # The study's best effort, on every fold: twice the steps.
    for fold in range(3):
        yield Run(f"long-fold{fold}-seed0", replace(base, epochs=16, fold=fold, objective=GHOSTLESS))
    for seed in range(3):
        for name in ("antighost", "antighost-frame"):
            yield Run(f"{name}-fold0-seed{seed}", replace(base, objective=LOSSES[name], seed=seed))
    for name in ("mse", "ghostless"):
        arch = replace(base.arch, output="vector")
        yield Run(f"vec-{name}-fold0-seed0", replace(base, arch=arch, objective=LOSSES[name]))
    for name in ("hinge", "r2-frame", "capped"):
        yield Run(f"{name}-fold0-seed0", replace(base, objective=LOSSES[name]))


def shapes(arch: Architecture) -> dict[str, Architecture]:
    """Networks beside the base one, all trained with MSE on the same batches."""
    return {
        "unet": replace(arch, name="unet"),
        "monai-unet": replace(arch, name="monai-unet", stem=1),
        "film": replace(arch, condition="film"),
        "total": replace(arch, total=True),
        "vector": replace(arch, output="vector", total=True),
        "stem4": replace(arch, stem=4, levels=2),
        "stem4-detail": replace(arch, stem=4, levels=2, detail=True),
    }


def fine_runs() -> Iterator[Run]:
    """On 128²: what the stem of the live network costs in error, at equal steps."""
    base = replace(small(), size=128, epochs=6)
    for name, stem, detail in (("stem2", 2, False), ("stem4", 4, False), ("stem4-detail", 4, True)):
        arch = replace(base.arch, stem=stem, levels=3, detail=detail)
        yield Run(f"{name}-fold0-seed0", replace(base, arch=arch))
    yield Run("stem1-fold0-seed0", replace(base, arch=replace(base.arch, stem=1, levels=4)))


def large_runs() -> Iterator[Run]:
    """On five times the sequences, in every fold: what a network can do that has enough of them, and what a
    price on ghosts costs it then."""
    base = replace(small(), epochs=10)
    for fold in range(base.folds):
        for name in ("ghostless", "mse"):
            settings = replace(base, fold=fold, objective=LOSSES[name])
            yield Run(f"{name}-fold{fold}-seed0", settings, controlled=False)
    yield Run("wide-fold0-seed0", replace(base, arch=replace(base.arch, width=32)), controlled=False)
    # What `learn train --preset cpu` takes: its epochs have so many frames, however many sequences there are.
    yield Run("cpu-fold0-seed0", preset("cpu", folds=base.folds), controlled=False)


BESIDE: dict[str, tuple[tuple[int, int, int], ...]] = {
    "live": ((16, 4, 3), (8, 4, 4), (12, 4, 4), (16, 4, 4)),
    "cpu": ((16, 2, 4), (16, 4, 4), (16, 4, 3), (8, 2, 4), (8, 4, 4)),
    "tiny": ((8, 2, 3),),
}
"""Width, stem and levels of each preset's network and of those beside it that cost about as much or less;
for `tiny` those that `ideal_runs` lack. `paper` has none: its network is the published one, and too large to
be trained on a CPU."""


def preset_runs() -> Iterator[Run]:
    """Each preset's network beside its neighbours, on the preset's grid, with its loss and dropout: for the
    fronts of `bench pareto`. All else is the study's: steps, batches, learning rate, and magnitude output (a
    vector map, three times as much to learn, stays on a plateau for as long as these runs are)."""
    study = small()
    for seed in range(2):
        for name, shapes in BESIDE.items():
            base = replace(study, **{k: getattr(preset(name), k) for k in ("size", "objective")}, seed=seed)
            for width, stem, levels in shapes:
                dropout = preset(name).arch.dropout
                arch = replace(study.arch, width=width, stem=stem, levels=levels, dropout=dropout)
                called = f"{base.size}-w{width}-stem{stem}-depth{levels}-fold0-seed{seed}"
                yield Run(called, replace(base, arch=arch), controlled=False)


def pictured(job: Job, grid: Grid) -> Job:
    """The job with pictures of at least a pixel a cell: on coarser ones a fine grid would learn of nothing
    that a coarser grid doesn't have."""
    wide, tall = job.render.size
    times = -(-grid.size // wide)
    return job.model_copy(
        update={"render": job.render.model_copy(update={"size": (times * wide, times * tall)})}
    )


def recovered_runs() -> Iterator[Run]:
    """On rendered sequences: what training on recovered flow changes when the test is recovered flow."""
    base = replace(small(), frames=0, epochs=16)
    for fold in range(3):
        yield Run(f"ideal-on-recovered-fold{fold}", replace(base, fold=fold), source="recovered")
        yield Run(f"recovered-fold{fold}", replace(base, fold=fold, input="recovered"), source="recovered")
        yield Run(f"mixed-fold{fold}", replace(base, fold=fold, input="mixed"), source="recovered")
        yield Run(f"ideal-fold{fold}", replace(base, fold=fold))


@measuring("--cache cache --out runs/learn")
def experiment(
    cache: Annotated[Path, typer.Option(help="Folder for packed sequences; made once.")],
    rendered: Annotated[
        Path | None, typer.Option(help="Dataset rendered from docs/results/learn/data/rendered.yaml.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results.")] = RESULTS,
    only: Annotated[str, typer.Option(help="Only runs whose name holds this.")] = "",
    fine: Annotated[bool, typer.Option("--fine", help="The runs on 128² instead of those on 64².")] = False,
    presets: Annotated[
        bool, typer.Option("--presets", help="The presets' networks and those beside them, each on its grid.")
    ] = False,
    large: Annotated[bool, typer.Option("--large", help=f"Runs on {LARGE} sequences, every fold.")] = False,
) -> None:
    """Train and score learn's choices; done runs are kept, the summary is made anew."""
    if (rendered is not None) + fine + presets + large > 1:
        raise UserError(
            "--rendered, --fine, --presets and --large each have their own runs: give one of them"
        )
    set_threads(1)
    say = Console(stderr=True).print
    packed: dict[int, list[Clip]] = {}

    @functools.cache
    def job() -> Job:
        found = reader.load_job(str(RESULTS / "data/labels.yaml"))
        return found.model_copy(update={"sequences": LARGE}) if large else found

    def sequences(grid: Grid) -> list[Clip]:
        if grid.size not in packed:
            packed[grid.size] = (
                labels(pictured(job(), grid), grid, cache)
                if rendered is None
                else load_clips(rendered, grid, ("ideal", "recovered"), cache=cache)
            )
        return packed[grid.size]

    if rendered is not None:
        name, runs = "recovered", list(recovered_runs())
    elif presets:
        name, runs = "presets", list(preset_runs())
    elif large:
        name, runs = "large", list(large_runs())
    else:
        name, runs = ("fine", list(fine_runs())) if fine else ("ideal", list(ideal_runs()))
    # What the code no longer asks for, or asks otherwise, leaves the table.
    asked = {run.name: json.loads(json.dumps(run.settings.as_dict())) for run in runs}
    table = {r["name"]: r for r in run_table.read(out / name) if r["settings"] == asked.get(r["name"])}
    for run in runs:
        if only in run.name:
            # A press costs a sequence: once is enough to say what calibration gives.
            pressed = name == "ideal" and run.name in PRESSED
            presses = (lambda index: press(job(), index, small().grid, cache)) if pressed else None
            table[run.name] = carry_out(run, sequences(run.settings.grid), cache, say, presses)
            run_table.write(out / name, list(table.values()))
    write(out)
    say(f"{out}/README.md")
