"""Error and cost of jobs tuned by `synth tune`, on sequences that were not used for tuning."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from evidence import report
from evidence.intervals import mean_of
from evidence.study import Study
from synth.job import reader
from synth.tune import search
from synth.tune.search import differences

_JOBS = report.RESULTS / "tune"
_WORDS = (
    "The force is estimated from the displacement of a frame by a fixed linear rule (`synth/tune`). *Error*: "
    "of the force estimated from recovered displacement against the true force at full fidelity, root mean "
    "square relative to the force, mean over sequences. *Used* of the budget: the increase of the error over "
    "full fidelity, or the change of the label, whichever is larger. Intervals are over fresh sequences; "
    "costs are CPU time of physics, scene, rendering and flow.",
)


def measure(
    scenes: str = "easy,middle,hard",
    budgets: str = "force 5%,force 3%",
    probes: int = 2,
    checks: int = 2,
    fresh: int = 6,
) -> dict[str, Any]:
    """Tunes scenes of different difficulty and checks budget and cost on fresh sequences.

    `scenes`: names of jobs next to the results; `probes`: sequences on which every setting is measured;
    `checks`: further ones for complete jobs; `fresh`: sequences not used for tuning, at least three.
    """
    rows = []
    for scene in scenes.split(","):
        job = reader.load_job(str(_JOBS / f"{scene}.yaml"))
        # Each budget reuses the measurements of the one before.
        measurements = search.Measurements(job)
        for budget in map(search.parse_budget, budgets.split(",")):
            tuned = search.tune(measurements, budget, probes, checks)
            others = range(probes + checks, probes + checks + fresh)
            whole = (
                ("full", "full", tuned.full),
                ("own", "before", tuned.own),
                ("best", "after", tuned.best),
            )
            changes = dict(differences(tuned.best.settings, tuned.own.settings))
            row: dict[str, Any] = {"scene": scene, "budget": budget, "changes": changes}
            row |= {name: _described(one) for name, _, one in whole}
            row["fresh"] = {
                name: _described(measurements.evaluate(one.settings, others)) for _, name, one in whole
            }
            rows.append(row)
    return {"rows": rows}


def _described(one: search.Evaluation) -> dict[str, Any]:
    """An evaluation as JSON; None where a sequence failed."""
    errors, totals, (cost,) = (
        [float(value) if np.isfinite(value) else None for value in values]
        for values in (one.growths, one.errors, [one.stages.sum()])
    )
    return {"settings": dict(one.settings), "errors": errors, "totals": totals, "cpu_s_a_frame": cost}


def page(found: Mapping[str, Any]) -> report.Page:
    """Draws `tune.json`: error of the force against cost of complete jobs."""
    panels = []
    for (scene,), rows in report.grouped(found["rows"], "scene").items():
        curves = []
        for row in rows:
            whole = row["full"], row["own"], row["best"]
            costs = tuple(one["cpu_s_a_frame"] for one in whole)
            errors = tuple(100 * _mean(one["totals"]) for one in whole)
            labels, name = ("full", "untuned", "tuned"), f"budget {100 * row['budget']:g}%"
            curves.append(report.Curve(name, costs, errors, labels, ringed=(2,)))
        panels.append(report.Panel(scene, "CPU s a frame", "error of the force [%]", tuple(curves)))
    sections = [report.Section("", table(found["rows"]))]
    words = [_verdict(found["rows"]), *found.get("notes", ()), *_WORDS]
    return report.Page("Tuning: error and cost on fresh sequences", found, panels, sections, words)


def _verdict(rows: list[dict[str, Any]]) -> str:
    within = [_mean(row["fresh"]["after"]["errors"]) <= row["budget"] for row in rows]
    costs = [row["fresh"][kind]["cpu_s_a_frame"] for row in rows for kind in ("after", "before")]
    ratios = [after / before for after, before in zip(costs[::2], costs[1::2], strict=True)]
    return (
        f"**The mean over fresh sequences is within the budget in {sum(within)} of {len(within)} cases, at "
        f"{min(ratios):.2f} to {max(ratios):.2f} times the cost of the untuned job.**"
    )


def table(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One line for each scene and budget."""
    lines = []
    for row in rows:
        full, before, after = (row["fresh"][kind] for kind in ("full", "before", "after"))
        errors = (f"{100 * _mean(one['totals']):.1f}" for one in (full, before, after))
        lines.append(
            {
                "scene": row["scene"],
                "budget [%]": 100 * row["budget"],
                "used, probes [%]": f"{100 * _mean(row['best']['errors']):.1f}",
                "used, fresh [%]": _over(after["errors"]),
                "used untuned, fresh [%]": _over(before["errors"]),
                "error, fresh: full, untuned, tuned [%]": ", ".join(errors),
                "CPU s a frame, untuned": before["cpu_s_a_frame"],
                "CPU s a frame, tuned": after["cpu_s_a_frame"],
                "cost ratio": after["cpu_s_a_frame"] / before["cpu_s_a_frame"],
                "changes": ", ".join(f"{key} {value}" for key, value in row["changes"].items()),
            }
        )
    return lines


def _mean(values: list[float | None]) -> float:
    """Mean, NaN if a sequence failed."""
    return float(np.mean(np.array(values, float)))


def _over(values: list[float | None]) -> str:
    """Mean over sequences with its interval, in percent."""
    if None in values:
        return "out of range"
    return report.mean_cell(mean_of(values), ".1f", 100)


STUDY = Study(measure, "tune/tune.json", page)
