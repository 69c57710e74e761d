"""Slides at constant force over the relief: displacement per force must not jump between frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import typer

from bench.output import charts
from bench.output.result_page import Page, Section
from evidence.fem.stability import compliance_steps
from evidence.measuring import measuring
from synth.errors import UserError
from synth.job.schema import Job
from synth.sequence import pipeline, scenario


@measuring(
    "--scenes 10",
    said="Folder for the data.",
    file="slides.json",
    text=lambda found: str({key: found[key] for key in list(found)[2:6]}),
)
def slides(
    scenes: Annotated[int, typer.Option(help="How many.", min=1)] = 100,
    seed: Annotated[int, typer.Option(help="Of the scenes.")] = 0,
) -> dict[str, Any]:
    """Largest step of displacement per force in random slides of the default job."""
    job = Job.model_validate({"seed": seed, "sequences": scenes, "fem": {"gestures": ["slide"]}})
    rows: list[dict[str, Any]] = []
    for index in range(scenes):
        case = scenario.draw(job, index)
        row: dict[str, Any] = {"index": index, "load": case.gesture.load}
        try:
            rows.append(row | compliance_steps(pipeline.move(job, case, *pipeline.build(job, case))))
        except UserError as refusal:
            rows.append(row | {"refused": str(refusal)})
    moved = [row for row in rows if "peak" in row]
    return {
        "refused": len(rows) - len(moved),
        "worst_peak": max((row["peak"] for row in moved), default=float("nan")),
        "worst_mean": max((row["mean"] for row in moved), default=float("nan")),
        "median_peak": float(np.median([row["peak"] for row in moved])),
        "rows": rows,
    }


def drawn(found: Mapping[str, Any]) -> Page:
    """What the data say."""
    rows = found["rows"]
    loads, steps = tuple(row["load"] for row in rows), tuple(100 * row["peak"] for row in rows)
    curve = charts.Curve("peak", loads, steps, labels=tuple(str(row["index"]) for row in rows))
    title = "Slides: largest change of displacement per force from frame to frame"
    said = [{name: value for name, value in found.items() if isinstance(value, int | float)}]
    return Page(title, found, [charts.Panel(title, "load P", "%", (curve,))], [Section("Summary", said)])
