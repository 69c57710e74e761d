"""Learning curves: error of the force against fitted sequences, by model, displacement and cameras.

Every estimator is fitted on 30, 100, 300, ... sequences of one dataset and tested on held-out sequences of it
and on whole datasets out of distribution. Each row is stored at once: an interrupted run continues.

Run: python -m evidence.curves.experiment mission --unseen mission-ood --sizes 30,100, with datasets of the
job `mission` and of mission-ood.yaml in this folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product, starmap
from pathlib import Path
from typing import Annotated, Any

import typer
from joblib import Parallel, delayed

from evidence import report, status
from evidence.curves import estimators
from evidence.curves.estimators import SAME, Estimator, Experiment
from synth.dataset.store import Dataset
from synth.errors import UserError

_PARTS = {"whole": "Error of the force", "along": "Its part along the line of sight"}
_NAMES = {1: "monocular", 2: "stereo"}


def main(
    data: Annotated[Path, typer.Argument(help="Dataset; its first sequences test and select epochs.")],
    unseen: Annotated[list[Path] | None, typer.Option(help="Datasets that are only tested on.")] = None,
    sizes: Annotated[str, typer.Option(help="Comma-separated numbers of sequences.")] = "300,1000,2800",
    models: Annotated[str, typer.Option(help="Comma-separated estimators.")] = ",".join(estimators.MODELS),
    inputs: Annotated[str, typer.Option(help="Comma-separated: recovered, exact.")] = "recovered",
    cameras: Annotated[str, typer.Option(help="Comma-separated: 1, 2.")] = "1,2",
    steps: Annotated[int, typer.Option(min=1, help="Approximate number of training batches.")] = 4000,
    test: Annotated[int, typer.Option(min=4, help="Sequences of `data` to test on.")] = 100,
    select: Annotated[int, typer.Option(min=2, help="Sequences of `data` that select an epoch.")] = 40,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = report.RESULTS / "learn/curves",
    work: Annotated[Path, typer.Option(help="Folder for packed sequences, networks and rows.")] = Path(
        "runs/curves"
    ),
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> None:
    """Error of the force against fitted sequences, by model, displacement and cameras."""
    ood = tuple(unseen or ())
    experiment = Experiment(data, ood, test, select, steps, work)
    numbers, counted = [int(n) for n in sizes.split(",")], [int(n) for n in cameras.split(",")]
    wanted = _wanted(numbers, models.split(","), inputs.split(","), counted)
    if max(numbers) > (left := len(Dataset(data)) - test - select):
        raise UserError(f"--sizes: at most {left}: {data} has no more after --test and --select")
    experiment.pack()
    rows = Parallel(workers, verbose=10)(delayed(experiment.rows)(one) for one in wanted)
    found = {
        "data": status.data(data, *ood),
        "generation_cpu_s": estimators.generation_cpu_s(data),
        "tested": {SAME: test} | {root.name: len(Dataset(root)) for root in ood},
        "rows": [row for of_estimator in rows for row in of_estimator],
    }
    shown = {one.heading: one.rows for one in page(found).sections}
    report.publish(out, "curves.json", found, page, shown)


def _wanted(
    sizes: Sequence[int], models: Sequence[str], inputs: Sequence[str], cameras: Sequence[int]
) -> list[Estimator]:
    """Estimators by size, smallest first, so that an interrupted run has the start of every curve."""
    for known, named, word in ((estimators.MODELS, models, "models"), (estimators.SOURCES, inputs, "inputs")):
        if unknown := set(named) - set(known):
            raise UserError(f"--{word}: {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    return [
        Estimator(model, source, count, size)
        for size, model, source, count in product(sorted(sizes), models, inputs, cameras)
    ]


def page(found: Mapping[str, Any]) -> report.Page:
    """A panel for every tested dataset and number of cameras; tables with a column for every size."""
    groups: dict[tuple[str, int], list[Mapping[str, Any]]] = {}
    for row in found["rows"]:
        groups.setdefault((row["tested"], row["cameras"]), []).append(row)
    groups = dict(sorted(groups.items(), key=lambda one: (one[0][0] != SAME, *one[0])))
    last = [*groups][-1][0]
    rows = [row for (tested, _), own in groups.items() if tested == last for row in own]
    return report.Page(
        "Learning curves",
        found,
        [_panel(own, f"{name}, {_NAMES[cameras]}") for (name, cameras), own in groups.items()],
        [report.Section(heading, _table(rows, part)) for part, heading in _PARTS.items()],
        (
            f"**Least error of the force: {'; '.join(starmap(_verdict, groups.items()))}.**",
            "Root mean square error relative to that of the force, mean over sequences with 95% interval. "
            f"The tables are of {last}. Generation takes {found['generation_cpu_s']:.1f} CPU-s a sequence.",
        ),
    )


def _verdict(group: tuple[str, int], rows: Sequence[Mapping[str, Any]]) -> str:
    best = min(rows, key=lambda row: float(row["whole"][0]))
    error = report.percent(best["whole"])
    return f"{group[0]}, {_NAMES[group[1]]}: {error} with {best['model']} on {best['size']} sequences"


def _panel(rows: Sequence[Mapping[str, Any]], title: str) -> report.Panel:
    curves = []
    for model, source in dict.fromkeys((row["model"], row["input"]) for row in rows):
        line = sorted((r["size"], r["whole"][0]) for r in rows if (r["model"], r["input"]) == (model, source))
        x, y = zip(*line, strict=True)
        curves.append(report.Curve(f"{model}, {source}", x, y))
    return report.Panel(title, "fitted sequences", "error of the force", tuple(curves), log_x=True)


def _table(rows: Sequence[Mapping[str, Any]], part: str) -> list[dict[str, Any]]:
    lines: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        names = {"cameras": row["cameras"], "model": row["model"], "fitted on": row["input"]}
        line = lines.setdefault(tuple(names.values()), names)
        line[f"{row['size']} sequences"] = report.percent(row[part])
    return list(lines.values())


if __name__ == "__main__":
    typer.run(main)
