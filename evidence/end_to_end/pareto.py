"""Error of the force against cost, for whole pipelines: law, mesh, paths, flow and model.

A pipeline makes sequences, recovers their flow and fits a model on them. It is tested on sequences of other
scenes that a finer pipeline made, with flow recovered by its own estimator. Its cost is the CPU time of one
frame of its data and of one estimate.

One instrument pulls or pushes. The force along the line of sight is visible in flow only through the little
that tissue spreads under a push, so that the part across the line of sight is also reported by itself.

Run: python -m evidence.end_to_end.pareto --fit 8 --test 6 --out runs/end-to-end
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from evidence import report
from evidence.end_to_end import models
from evidence.end_to_end.pipelines import FINE, FRAMES, SIZE, Sequences, chosen, default_rendering, errors
from learn.evaluation.statistics import interval, paired

PARTS = {"": "errors", "across_": "across"}
"""The whole force, and its part across the line of sight: prefix of a row's keys, and key of the errors."""
_WHAT = {"": "the force", "across_": "the force across the line of sight"}


def main(
    out: Annotated[Path, typer.Option(help="Folder for results.")] = report.RESULTS / "end-to-end",
    work: Annotated[Path, typer.Option(help="Folder of intermediate results; a later run continues.")] = Path(
        "runs/end-to-end-work"
    ),
    fit: Annotated[int, typer.Option(min=4, help="Sequences that each pipeline makes to fit on.")] = 40,
    test: Annotated[int, typer.Option(min=3, help="Sequences that all are tested on.")] = 24,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 31,
) -> None:
    """Error of the force against CPU time a frame, for whole pipelines."""
    tested, pipelines = Sequences(FINE, FINE.job(seed + 1, test), work), chosen()
    renderings = dict.fromkeys(one.rendering for one in pipelines)
    made = {one: Sequences(one, one.job(seed, fit), work) for one in renderings}
    rows: list[dict[str, Any]] = []
    for one in pipelines:
        row = one.as_row() | errors(one, made[one.rendering], tested, work)
        flow_s = made[default_rendering()].flow_s(one.flow)
        costs = {"data_s": made[one.rendering].data_s(), "flow_s": flow_s}
        rows.append(row | costs | {"cpu_s": sum(costs.values()) + row["estimate_s"]})
        done = f"{len(rows)} of {len(pipelines)}: {one.name}, {100 * np.mean(row['errors']):.0f}%"
        typer.echo(done, err=True)
    true = [clip.force for clip in tested.clips("ideal")]
    nothing = models.errors([0 * force for force in true], true)
    found = {
        "tested": asdict(FINE) | {"size": SIZE, "frames": FRAMES, "sequences": test},
        "seed": seed,
        "zero": float(np.mean(nothing["errors"])),
        "across_zero": float(np.mean(nothing["across"])),
        "rows": summarised(rows, seed),
    }
    report.publish(out, "pareto.json", found, page, {"rows": page(found).sections[0].rows})


def summarised(rows: list[dict[str, Any]], seed: int) -> list[dict[str, Any]]:
    """Rows with mean errors and their difference from the default pipeline with the same model.

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
    """Mean, low and high of the error of `other` less that of `usual` on the same sequences (BCa)."""
    found = paired(np.asarray(usual), np.asarray(other), np.random.default_rng(seed)).difference
    return [found.mean, found.low, found.high]


def page(found: Mapping[str, Any]) -> report.Page:
    """Error against cost, and a table of the ridge pipelines, cheapest first."""
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
            f"**Across the line of sight the error of ridge is {least[0]:.0f} to {most[0]:.0f}% with flow by "
            f"{flow}, for every law, mesh and number of paths, and {least[1]:.0f} to {most[1]:.0f}% with "
            "other flow estimators.**",
            "Root mean square error relative to that of the force, mean over sequences with BCa intervals; "
            "*difference*: from the defaults, paired. Other models are in the data. Zero force has an error "
            f"of {100 * found['zero']:.0f}%, across the line of sight of {100 * found['across_zero']:.0f}%. "
            "CPU time: least measured for a frame of data, its flow and an estimate.",
        ),
    )


def _panel(found: Mapping[str, Any], part: str) -> report.Panel:
    """A curve for each model, a dot for each pipeline, and the error of zero force."""
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
    curves.append(report.Curve("zero force", (min(costs), max(costs)), (level, level)))
    title, unit = f"Error of {_WHAT[part]} (rings: defaults)", "RMSE [% of the whole force]"
    return report.Panel(title, "CPU s a frame", unit, tuple(curves), log_y=True, front=True)


def _cells(row: Mapping[str, Any]) -> dict[str, Any]:
    more = row["across_difference"]
    return {
        "pipeline": _name(row),
        "model": row["model"],
        "CPU s": f"{row['cpu_s']:.3f}",
        "error [%]": report.mean_cell([row[key] for key in ("rmse", "low", "high")], ".0f", 100),
        "across [%]": report.mean_cell([row[f"across_{key}"] for key in ("rmse", "low", "high")], ".0f", 100),
        "difference across": None if more is None else report.mean_cell(more, "+.1f", 100),
    }


def _name(row: Mapping[str, Any]) -> str:
    return f"{row['law']} {row['tets']}, {row['spp']} spp, {row['flow']}"


if __name__ == "__main__":
    typer.run(main)
