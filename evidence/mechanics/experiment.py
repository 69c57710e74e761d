"""`bench experiment mechanics`: which of a living brain's mechanics must be in the data, and at what cost?

A ridge and a network are fitted on the plain world and asked for the force in every other, of scenes with
anatomies that were never fitted; then fitted on the mixture of all and asked again. A world is compared with
the plain one on the same scenes, so that what differs is the world.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.output import result_page
from evidence.measuring import measuring
from evidence.mechanics import answers, costs, page
from evidence.mechanics.answers import Errors, Reader, Trial
from evidence.mechanics.worlds import MIXTURE, Scenes


@measuring(
    "--fit 14 --test 4 --epochs 2 --scenes 1 --out runs/mechanics",
    out="docs/results/mechanics",
    said="Folder for the results.",
    file="results.json",
    page=lambda found, out: result_page.write(page.drawn(found), out),
    text="README.md",
)
def experiment(
    work: Annotated[
        Path,
        typer.Option(help="Folder for sequences, networks and answers; what is there already is used."),
    ] = Path("runs/mechanics-work"),
    fit: Annotated[int, typer.Option(min=14, help="Sequences to fit on, of each of the two.")] = 35,
    test: Annotated[int, typer.Option(min=3, help="Sequences that are asked in every world.")] = 12,
    epochs: Annotated[int, typer.Option(min=1, help="Of the network.")] = 60,
    scenes: Annotated[int, typer.Option(min=1, help="Whose mechanics are timed in every world.")] = 6,
    rounds: Annotated[int, typer.Option(min=1, help="How often; the least counts.")] = 2,
    seed: Annotated[int, typer.Option(min=0, help="Root of every draw.")] = 41,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> dict[str, Any]:
    """What a force reader fitted on plain tissue errs in other mechanics, and what these cost."""

    def say(line: str) -> None:
        typer.echo(line, err=True)

    trial = Trial(Scenes(seed, fit, work), Scenes(seed + 1, test, work), epochs)
    refused = make(trial.wanted(), workers, say)
    found = ask(trial, workers, say)
    spent = costs.measure(scenes, rounds, seed, work, say)
    return {
        "seed": seed,
        "fitted": {"sequences": fit, "mixture": MIXTURE},
        "refused": refused,
        "seconds": spent,
        "rows": rows_of(found),
    }


def make(wanted: Iterable[tuple[Scenes, str, int]], workers: int, say: Callable[[str], None]) -> list[str]:
    """Renders what isn't there; gives back which sequences were refused, and why."""
    refused, done, wanted = [], 0, list(wanted)
    with _pool(workers) as pool:
        asked = {pool.submit(one.make, name, k): (one, name, k) for one, name, k in wanted}
        for job in as_completed(asked):
            one, name, k = asked[job]
            done += 1
            if why := job.result():
                refused.append(f"{name}, seed {one.seed}, sequence {k}: {why}")
            if done % 20 == 0:
                say(f"{done} of {len(wanted)} sequences")
    return sorted(refused)


def ask(trial: Trial, workers: int, say: Callable[[str], None]) -> dict[Reader, Errors]:
    """What every reader errs by."""
    found = {}
    with _pool(workers) as pool:
        asked = {pool.submit(trial.errors, one): one for one in answers.readers()}
        for job in as_completed(asked):
            found[asked[job]] = job.result()
            say(f"{len(found)} of {len(asked)}: {asked[job].slug}")
    return {one: found[one] for one in answers.readers()}


def rows_of(found: Mapping[Reader, Errors]) -> list[dict[str, Any]]:
    """A row a reader and world: errors by sequence, as a part of the force."""
    return [
        asdict(one) | {"world": name} | errors
        for one, by_world in found.items()
        for name, errors in by_world.items()
    ]


def _pool(workers: int) -> ProcessPoolExecutor:
    # Without max_tasks_per_child: Python 3.11's pool stands still when it replaces a process.
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
