"""Error of the force against cost, for whole pipelines: law, mesh, paths, flow and model.

A pipeline makes sequences, recovers their flow and fits a model on them; it is asked for the force of
sequences that a finer pipeline made of scenes it has not seen, from the flow that its own estimator recovers
there. Its cost is the CPU time of one frame of its data and of one answer.

One instrument pulls or pushes: flow shows the force along the line of sight only through the little that
tissue spreads under a push, so the part across the line of sight is judged by itself besides.

Run: python -m evidence.end_to_end.pareto --fit 8 --test 6 --out runs/end-to-end
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from evidence import report
from evidence.end_to_end import models
from evidence.end_to_end.pipelines import FINE, FRAMES, SIZE, Sequences, chosen, default_world, errors
from learn.evaluation.statistics import interval, paired

PARTS = {"": "errors", "across_": "across"}
"""What defaults are judged by: the whole force, and its part across the line of sight. Prefix of the names in
a row, and the errors by sequence."""
_WHAT = {"": "the force", "across_": "the force across the line of sight"}


def main(
    out: Annotated[Path, typer.Option(help="Folder for results.")] = report.RESULTS / "end-to-end",
    work: Annotated[Path, typer.Option(help="Folder for sequences, flow and answers, to go on from.")] = Path(
        "runs/end-to-end-work"
    ),
    fit: Annotated[int, typer.Option(min=4, help="Sequences that each pipeline makes to fit on.")] = 40,
    test: Annotated[int, typer.Option(min=3, help="Sequences that all are asked about.")] = 24,
    seed: Annotated[int, typer.Option(min=0, help="Root of every draw.")] = 31,
) -> None:
    """Error of the force against CPU time a frame, for whole pipelines."""
    asked, pipelines = Sequences(FINE, FINE.job(seed + 1, test), work), chosen()
    worlds = dict.fromkeys(one.world for one in pipelines)
    made = {world: Sequences(world, world.job(seed, fit), work) for world in worlds}
    rows: list[dict[str, Any]] = []
    for one in pipelines:
        row = one.as_row() | errors(one, made[one.world], asked, work)
        costs = {"data_s": made[one.world].data_s(), "flow_s": made[default_world()].flow_s(one.flow)}
        rows.append(row | costs | {"cpu_s": sum(costs.values()) + row["answer_s"]})
        done = f"{len(rows)} of {len(pipelines)}: {one.name}, {100 * np.mean(row['errors']):.0f}%"
        typer.echo(done, err=True)
    still = [clip.force for clip in asked.clips("ideal")]
    nothing = models.errors([0 * force for force in still], still)
    found = {
        "asked": asdict(FINE) | {"size": SIZE, "frames": FRAMES, "sequences": test},
        "seed": seed,
        "zero": float(np.mean(nothing["errors"])),
        "across_zero": float(np.mean(nothing["across"])),
        "rows": summarised(rows, seed),
    }
    report.save(out, "pareto.json", found, page(found))
    report.show({"rows": page(found).sections[0].rows})


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


def page(found: Mapping[str, Any]) -> report.Page:
    """Error against cost, which pipelines differ from the defaults, and a table, the cheapest first."""
    rows = sorted(found["rows"], key=lambda row: float(row["cpu_s"]))
    ridge = [row for row in rows if row["model"] == models.RIDGE]
    flow = next(row["flow"] for row in ridge if row["default"])
    found_flow = [row for row in ridge if row["flow"] != "ideal"]
    off = [
        [100 * r["across_rmse"] for r in found_flow if (r["flow"] == flow) == own] for own in (True, False)
    ]
    least, most = [min(some) for some in off], [max(some) for some in off]
    return report.Page(
        "Which part of a whole pipeline pays?",
        found,
        [_panel(found, part) for part in PARTS],
        [report.Section("", [_cells(row) for row in ridge])],
        (
            f"**Across the line of sight ridge errs by {least[0]:.0f} to {most[0]:.0f}% on flow by {flow}, "
            f"whatever law, mesh and paths, on other estimators' by {least[1]:.0f} to {most[1]:.0f}%.**",
            "Root mean square error over frames as a part of the force's own, mean over "
            "sequences with BCa intervals; *more*: paired with the defaults. Other readers are in the data. "
            f"No force at all errs by {100 * found['zero']:.0f}%, across the line of sight by "
            f"{100 * found['across_zero']:.0f}%. CPU time is that of a frame of data, its flow and an "
            "answer, the least that was measured.",
        ),
    )


def _panel(found: Mapping[str, Any], part: str) -> report.Panel:
    """A curve a model, a dot a pipeline; and what no force at all errs by."""
    rows = found["rows"]
    curves = []
    for model in dict.fromkeys(row["model"] for row in rows):
        own = [row for row in rows if row["model"] == model]
        errs = tuple(100 * float(row[f"{part}rmse"]) for row in own)
        ends = tuple((100 * float(row[f"{part}low"]), 100 * float(row[f"{part}high"])) for row in own)
        ringed = tuple(k for k, row in enumerate(own) if row["default"])
        cost, labels = tuple(float(row["cpu_s"]) for row in own), tuple(map(_name, own))
        curves.append(report.Curve(model, cost, errs, labels, ringed, ends, named=False))
    costs, level = [float(row["cpu_s"]) for row in rows], 100 * float(found[f"{part}zero"])
    curves.append(report.Curve("no force at all", (min(costs), max(costs)), (level, level)))
    title, unit = f"Error of {_WHAT[part]} (rings: defaults)", "RMSE [% of the whole force]"
    return report.Panel(title, "CPU s a frame", unit, tuple(curves), log_y=True, front=True)


def _cells(row: Mapping[str, Any]) -> dict[str, Any]:
    def ends(values: Sequence[float] | None, form: str) -> str | None:
        if values is None:
            return None
        mean, low, high = (f"{100 * value:{form}}" for value in values)
        return f"{mean} [{low}, {high}]"

    return {
        "pipeline": _name(row),
        "model": row["model"],
        "CPU s": f"{row['cpu_s']:.3f}",
        "error [%]": ends([row["rmse"], row["low"], row["high"]], ".0f"),
        "across [%]": ends([row["across_rmse"], row["across_low"], row["across_high"]], ".0f"),
        "more across": ends(row["across_difference"], "+.1f"),
    }


def _name(row: Mapping[str, Any]) -> str:
    return f"{row['law']} {row['tets']}, {row['spp']} spp, {row['flow']}"


if __name__ == "__main__":
    typer.run(main)
