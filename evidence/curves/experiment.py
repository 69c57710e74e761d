"""`bench experiment curves`: what more sequences buy, by model, displacement and number of eyes.

Every reader is fitted on 30, 100, 300, ... sequences of one dataset and asked about sequences of it that none
was fitted on, and about whole datasets of other worlds. A row is kept as soon as it is there: an
interrupted run goes on.
"""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.output import result_page
from evidence.curves import page, readers
from evidence.curves.readers import Reader, World
from evidence.measuring import measuring
from synth.errors import UserError


@measuring(
    "mission --unseen mission-unseen --sizes 30,100",
    out="docs/results/learn/curves",
    file="curves.json",
    page=lambda found, folder: result_page.write(page.drawn(found), folder),
    text="README.md",
)
def experiment(
    data: Annotated[
        Path, typer.Argument(help="Dataset to fit on; its first sequences are asked and choose epochs.")
    ],
    unseen: Annotated[
        list[Path] | None, typer.Option(help="Datasets that are only asked about; may be given again.")
    ] = None,
    sizes: Annotated[str, typer.Option(help="Comma-separated numbers of fitted sequences.")] = "30,100,300",
    models: Annotated[str, typer.Option(help="Comma-separated readers.")] = ",".join(readers.MODELS),
    inputs: Annotated[
        str, typer.Option(help="Comma-separated: ideal, noise, recovered, mixed; exact is asked with, too.")
    ] = ",".join(readers.INPUTS),
    eyes: Annotated[str, typer.Option(help="Comma-separated: 1, 2.")] = "1,2",
    seeds: Annotated[int, typer.Option(min=1, help="Networks a point.")] = 1,
    steps: Annotated[
        int, typer.Option(min=1, help="Batches of 16 that a network is trained with, about.")
    ] = 4000,
    asked: Annotated[int, typer.Option(min=4, help="Sequences of `data` asked about.")] = 150,
    choosing: Annotated[int, typer.Option(min=2, help="Sequences of `data` that choose an epoch.")] = 60,
    work: Annotated[Path, typer.Option(help="Folder for packed sequences, networks and rows.")] = Path(
        "runs/curves"
    ),
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    add: Annotated[
        list[Path] | None,
        typer.Option(help="curves.json of another run on these data, to be shown with; may be given again."),
    ] = None,
) -> dict[str, Any]:
    """Error of the force against fitted sequences and CPU-hours, by model, displacement and eyes."""
    world = World(data, tuple(unseen or ()), asked, choosing, steps, work)
    wanted = list(_wanted(_split(sizes), _words(models), _words(inputs), _split(eyes), seeds))
    limit = world.check()
    if max(one.size for one in wanted) > limit:
        raise UserError(
            f"--sizes: at most {limit}; {data} leaves no more beside those that choose and are asked"
        )
    others = [_read(file) for file in add or ()]
    joined((), others, world.counts())  # what can't be joined is refused before anything is fitted
    world.pack()
    rows: dict[Reader, list[dict[str, Any]]] = {}
    # Without max_tasks_per_child: Python 3.11's pool stands still when it replaces a process.
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        under_way = {pool.submit(world.rows, one): one for one in wanted}
        try:
            for job in as_completed(under_way):
                rows[under_way[job]] = job.result()
                typer.echo(f"{len(rows)} of {len(wanted)}: {under_way[job].slug}", err=True)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # what waits would be computed in vain
            raise
    own, counts = [with_intervals(row) for one in wanted for row in rows[one]], world.counts()
    found: dict[str, Any] = {"generation_cpu_s": world.generation_cpu_s(), "asked": counts}
    found |= {"rows": joined(own, others, counts)}
    # What is added may be of an earlier day's code; its commands say so.
    added = [said for one in others for said in (*one.get("added", ()), one["command"])]
    return found | ({"added": list(dict.fromkeys(added))} if added else {})


def joined(
    own: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]], asked: dict[str, int]
) -> list[dict[str, Any]]:
    """Rows of other runs, without those that this one has, and this one's. UserError if they asked others."""
    fields = ("model", "input", "eyes", "size", "seed", "asked")
    rows: dict[tuple[Any, ...], dict[str, Any]] = {}
    for one in others:
        if one["asked"] != asked:
            raise UserError(f"--add: {one['command']!r} asked {one['asked']}, this run {asked}")
        rows |= {tuple(row[name] for name in fields): with_intervals(row) for row in one["rows"]}
    rows |= {tuple(row[name] for name in fields): row for row in own}
    return list(rows.values())


def _read(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"--add {file}: {error}") from None
    if not isinstance(found, dict) or not {"command", "asked", "rows"} <= found.keys():
        raise UserError(f"--add {file}: is no curves.json")
    return found


def with_intervals(row: dict[str, Any]) -> dict[str, Any]:
    """A row with every error and the ends of its interval as one list of three."""
    ends = {f"{name}_{end}" for name in row for end in ("low", "high")}
    packed = {name: value for name, value in row.items() if name not in ends}
    for name in row.keys() - ends:
        if f"{name}_low" in row and row[name] is not None:
            packed[name] = [row[name], row[f"{name}_low"], row[f"{name}_high"]]
    return packed


def _words(said: str) -> list[str]:
    return [one.strip() for one in said.split(",") if one.strip()]


def _split(said: str) -> list[int]:
    try:
        return [int(one) for one in _words(said)]
    except ValueError:
        raise UserError(f"{said!r}: whole numbers with commas between them") from None


def _wanted(
    sizes: Sequence[int], models: Sequence[str], inputs: Sequence[str], eyes: Sequence[int], seeds: int
) -> Iterator[Reader]:
    """Smallest first: what a short run leaves is a whole curve's beginning."""
    for known, given, word in ((readers.KNOWN, models, "models"), (readers.INPUTS, inputs, "inputs")):
        if unknown := set(given) - set(known):
            raise UserError(f"--{word}: {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    for size in sorted(sizes):
        for model in models:
            for given in inputs:
                for eye in eyes:
                    # Drawn noise is a question of networks and one eye: that of `bench gap`.
                    if given in ("noise", "mixed") and (model not in readers.NETWORKS):
                        continue
                    if given == "noise" and eye == 2:
                        continue
                    for seed in range(seeds if model in readers.NETWORKS else 1):
                        yield Reader(model, given, eye, size, seed)
