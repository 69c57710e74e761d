"""What learn's choices are worth: folds, losses, controls, on labels-only and on rendered sequences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from bench.learn_labels import clips as labels
from bench.learn_runs import Run, carry_out
from bench.learn_summary import write
from learn.data import Clip, load
from learn.grid import Grid
from learn.loss import Objective
from learn.settings import Settings, preset
from learn.threads import set_threads
from synth import config

RESULTS = Path("docs/results/learn")


def small() -> Settings:
    """The study's base run: some 40 core-seconds, the same for every choice that is compared."""
    base = preset("tiny", epochs=10, frames=4, folds=3, objective=Objective(kind="mse"))
    return replace(base, arch=replace(base.arch, output="magnitude"))


def ideal_runs() -> Iterator[Run]:
    """On labels-only sequences, in the order of their worth; an interrupted study goes on where it was."""
    base, antighost = small(), Objective()
    published = Objective(kind="published", rule="frame")
    yield Run("mse-fold0-seed0", base)
    yield Run("antighost-fold0-seed0", replace(base, objective=antighost))
    yield Run("mse-fold1-seed0", replace(base, fold=1))
    yield Run("mse-fold2-seed0", replace(base, fold=2))
    yield Run("shuffled-fold0-seed0", base, control="shuffled")
    yield Run("published-fold0-seed0", replace(base, objective=published))
    yield Run("stem4-fold0-seed0", replace(base, arch=replace(base.arch, stem=4, levels=2)))
    yield Run("zero-fold0-seed0", base, control="zero")
    for seed in (1, 2):
        yield Run(f"mse-fold0-seed{seed}", replace(base, seed=seed))
        yield Run(f"antighost-fold0-seed{seed}", replace(base, objective=antighost, seed=seed))
        yield Run(f"published-fold0-seed{seed}", replace(base, objective=published, seed=seed))
    yield Run("vector-fold0-seed0", replace(base, arch=replace(base.arch, output="vector")))
    yield Run("unet-fold0-seed0", replace(base, arch=replace(base.arch, name="unet")))


def recovered_runs() -> Iterator[Run]:
    """On rendered sequences: what training on recovered flow changes when the test is recovered flow."""
    base = replace(small(), frames=0, epochs=16)
    for fold in range(3):
        yield Run(f"ideal-on-recovered-fold{fold}", replace(base, fold=fold), source="recovered")
        yield Run(f"recovered-fold{fold}", replace(base, fold=fold, input="recovered"), source="recovered")
        yield Run(f"mixed-fold{fold}", replace(base, fold=fold, input="mixed"), source="recovered")
        yield Run(f"ideal-fold{fold}", replace(base, fold=fold))


def experiment(
    cache: Annotated[Path, typer.Option(help="Folder for packed sequences; made once.")],
    rendered: Annotated[
        Path | None, typer.Option(help="Dataset rendered from docs/results/learn/data/rendered.yaml.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results.")] = RESULTS,
    only: Annotated[str, typer.Option(help="Only runs whose name holds this.")] = "",
) -> None:
    """Train and score learn's choices; done runs are kept, the summary is made anew."""
    set_threads(1)
    say = Console(stderr=True).print
    grid = Grid(small().size)
    if rendered is not None:
        _study(
            "recovered",
            recovered_runs(),
            load(rendered, grid, ("ideal", "recovered"), cache=cache),
            out,
            only,
        )
    else:
        job = config.load(str(RESULTS / "data/labels.yaml"))
        _study("ideal", ideal_runs(), labels(job, grid, cache), out, only)
    write(out)
    say(f"{out}/README.md")


def _study(name: str, runs: Iterator[Run], clips: list[Clip], out: Path, only: str) -> None:
    say = Console(stderr=True).print
    for run in runs:
        if only in run.name:
            carry_out(run, clips, out / name / "runs", say)
