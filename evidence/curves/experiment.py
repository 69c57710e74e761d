"""What more sequences buy: error of the force against fitted sequences, by model, displacement and eyes.

Every reader is fitted on 30, 100, 300, ... sequences of one dataset and asked about sequences of it that none
was fitted on, and about whole datasets of other worlds. A row is kept as soon as it is there: an
interrupted run goes on.

Run: python -m evidence.curves.experiment mission --unseen mission-ood --sizes 30,100, of the datasets
of the job `mission` and of mission-ood.yaml beside this file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import typer
from joblib import Parallel, delayed

from evidence import report, status
from evidence.curves import estimators
from evidence.curves.estimators import Reader, World
from synth.errors import UserError

_PARTS = {"whole": "Error of the force", "along": "Its part along the line of sight"}


def main(
    data: Annotated[Path, typer.Argument(help="Dataset; its first sequences are asked and choose epochs.")],
    unseen: Annotated[list[Path] | None, typer.Option(help="Datasets that are only asked about.")] = None,
    sizes: Annotated[
        str, typer.Option(help="Comma-separated numbers of fitted sequences.")
    ] = "300,1000,2800",
    models: Annotated[str, typer.Option(help="Comma-separated estimators.")] = ",".join(estimators.MODELS),
    inputs: Annotated[str, typer.Option(help="Comma-separated: recovered, exact.")] = "recovered",
    eyes: Annotated[str, typer.Option(help="Comma-separated: 1, 2.")] = "1,2",
    steps: Annotated[int, typer.Option(min=1, help="Batches that a network is trained with, about.")] = 4000,
    asked: Annotated[int, typer.Option(min=4, help="Sequences of `data` asked about.")] = 100,
    choosing: Annotated[int, typer.Option(min=2, help="Sequences of `data` that choose an epoch.")] = 40,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = report.RESULTS / "learn/curves",
    work: Annotated[Path, typer.Option(help="Folder for packed sequences, networks and rows.")] = Path(
        "runs/curves"
    ),
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> None:
    """Error of the force against fitted sequences, by model, displacement and eyes."""
    world = World(data, tuple(unseen or ()), asked, choosing, steps, work)
    numbers, counted = [int(n) for n in sizes.split(",")], [int(n) for n in eyes.split(",")]
    wanted = _wanted(numbers, models.split(","), inputs.split(","), counted)
    if max(numbers) > (limit := world.check()):
        raise UserError(f"--sizes: at most {limit}: {data} has no more beside those that are asked")
    world.pack()
    rows = Parallel(workers, verbose=10)(delayed(world.rows)(one) for one in wanted)
    found = {
        "data": status.data(data, *world.unseen),
        "generation_cpu_s": world.generation_cpu_s(),
        "asked": world.counts(),
        "rows": [row for of_reader in rows for row in of_reader],
    }
    report.save(out, "curves.json", found, page(found))
    report.show({one.heading: one.rows for one in page(found).sections})


def _wanted(
    sizes: Sequence[int], models: Sequence[str], inputs: Sequence[str], eyes: Sequence[int]
) -> list[Reader]:
    """Smallest first: what a short run leaves is a whole curve's beginning."""
    for known, given, word in ((estimators.MODELS, models, "models"), (estimators.SOURCES, inputs, "inputs")):
        if unknown := set(given) - set(known):
            raise UserError(f"--{word}: {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    return [
        Reader(model, given, eye, size)
        for size, model, given, eye in product(sorted(sizes), models, inputs, eyes)
    ]


def page(found: Mapping[str, Any]) -> report.Page:
    """A panel for every world asked about and number of eyes; tables with a column for every size."""
    rows = found["rows"]
    worlds, eyes = dict.fromkeys(row["asked"] for row in rows), sorted({row["eyes"] for row in rows})
    return report.Page(
        "Learning curves",
        found,
        [_panel(rows, asked, eye) for asked in worlds for eye in eyes],
        [report.Section(heading, _table(rows, part, [*worlds][-1])) for part, heading in _PARTS.items()],
        (
            " ".join(_verdict(rows, asked, eye) for asked in worlds for eye in eyes),
            "Root mean square error of the force as a part of the force's own, mean over sequences with its "
            f"95% interval. The tables are of {[*worlds][-1]}. Generation takes "
            f"{found['generation_cpu_s']:.1f} CPU-s a sequence.",
        ),
    )


def _verdict(rows: Sequence[Mapping[str, Any]], asked: str, eyes: int) -> str:
    mine = [row for row in rows if (row["asked"], row["eyes"]) == (asked, eyes)]
    best = min(mine, key=lambda row: float(row["whole"][0]))
    return f"{asked}, {eyes} eye(s): {best['model']} on {best['size']} errs least, {percent(best['whole'])}."


def _panel(rows: Sequence[Mapping[str, Any]], asked: str, eye: int) -> report.Panel:
    mine = [row for row in rows if row["asked"] == asked and row["eyes"] == eye]
    curves = []
    for model, given in dict.fromkeys((row["model"], row["input"]) for row in mine):
        line = sorted((r["size"], r["whole"][0]) for r in mine if (r["model"], r["input"]) == (model, given))
        x, y = zip(*line, strict=True)
        curves.append(report.Curve(f"{model}, {given}", x, y))
    title = f"{asked}, {'one eye' if eye == 1 else 'two eyes'}"
    return report.Panel(title, "fitted sequences", "error of the force", tuple(curves), log_x=True)


def _table(rows: Sequence[Mapping[str, Any]], part: str, asked: str) -> list[dict[str, Any]]:
    lines: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in sorted((row for row in rows if row["asked"] == asked), key=lambda row: int(row["eyes"])):
        names = {"eyes": row["eyes"], "model": row["model"], "fitted on": row["input"]}
        line = lines.setdefault(tuple(names.values()), names)
        line[f"{row['size']} sequences"] = percent(row[part])
    return list(lines.values())


def percent(values: Sequence[float] | None) -> str | None:
    """A mean and its interval as a cell of a table."""
    if values is None:
        return None
    mean, *ends = (f"{100 * value:.0f}" for value in values if value is not None)
    return f"{mean}% [{', '.join(ends)}]" if ends else f"{mean}%"


if __name__ == "__main__":
    typer.run(main)
