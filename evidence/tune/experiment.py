"""Does `synth tune` keep its budget on sequences that had no part in the choice, and what does it save?

Run: python -m evidence.tune.experiment
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from evidence import report
from learn.evaluation.statistics import interval
from synth.job import reader
from synth.tune import search
from synth.tune.grid import differences

_WORDS = (
    "The displacement of a frame stands for a force by a dual-weighted residual (`synth/tune/probe.py`). "
    "*Error*: how far that of recovered displacement is off the truth of full fidelity, root mean square "
    "over frames as a part of the force, mean over sequences. A setting *takes* of the budget by how much "
    "that is more than at full fidelity, or by how much the label itself moves, whichever is more. Intervals "
    "are over fresh sequences; costs are CPU time of physics, scene, rendering and flow.",
)


def main(
    out: Annotated[Path, typer.Option(help="Has a job SCENE.yaml for each scene.")] = report.RESULTS / "tune",
    scenes: str = "easy,middle,hard",
    budgets: str = "force 5%,force 3%",
    probes: Annotated[int, typer.Option(help="Sequences that every setting is measured on.")] = 2,
    checks: Annotated[int, typer.Option(help="Further ones for whole settings.")] = 2,
    fresh: Annotated[int, typer.Option(min=3, help="Sequences that had no part in the choice.")] = 6,
) -> None:
    """Tunes scenes of different difficulty and checks budget and cost on fresh sequences."""
    rows = []
    for scene in scenes.split(","):
        job = reader.load_job(str(out / f"{scene}.yaml"))
        journal = out / f"{scene}.part"
        # One budget after the other finds what was measured for the one before.
        measurements = search.Measurements(job, journal)
        for budget in map(search.parse_budget, budgets.split(",")):
            tuned = search.tune(measurements, budget, probes, checks)
            unseen = range(probes + checks, probes + checks + fresh)
            whole = {"full": tuned.full, "own": tuned.own, "best": tuned.best}
            again = {
                kind: measurements.evaluate(one.settings, unseen)
                for kind, one in zip(("full", "before", "after"), whole.values(), strict=True)
            }
            changes = dict(differences(tuned.best.settings, tuned.own.settings))
            described = {kind: _described(one) for kind, one in whole.items()}
            checked = {kind: _described(one) for kind, one in again.items()}
            rows.append({"scene": scene, "budget": budget, "changes": changes, **described, "fresh": checked})
        journal.unlink()
    kept = {"rows": rows}
    report.save(out, "tune.json", kept, page(kept))
    report.show({"rows": table(rows)})


def _described(one: search.Evaluation) -> dict[str, Any]:
    """Ready for JSON; None where a sequence could not be carried out."""
    errors, totals, (cost,) = (
        [float(value) if np.isfinite(value) else None for value in values]
        for values in (one.growths, one.errors, [one.stages.sum()])
    )
    return {"settings": dict(one.settings), "errors": errors, "totals": totals, "cpu_s_a_frame": cost}


def page(found: Mapping[str, Any]) -> report.Page:
    """Draws `tune.json`: error of the force over cost of whole jobs."""
    panels = []
    for scene in dict.fromkeys(row["scene"] for row in found["rows"]):
        curves = []
        for row in found["rows"]:
            if row["scene"] == scene:
                whole = row["full"], row["own"], row["best"]
                costs = tuple(one["cpu_s_a_frame"] for one in whole)
                errors = tuple(100 * _mean(one["totals"]) for one in whole)
                labels, name = ("full", "the job as it was", "tuned"), f"budget {100 * row['budget']:g}%"
                curves.append(report.Curve(name, costs, errors, labels, ringed=(2,)))
        panels.append(report.Panel(scene, "CPU s a frame", "error of the force [%]", tuple(curves)))
    sections = [report.Section("", table(found["rows"]))]
    words = [_verdict(found["rows"]), *found.get("notes", ()), *_WORDS]
    title = "Does tuning keep its budget on fresh sequences?"
    return report.Page(title, found, panels, sections, words)


def _verdict(rows: list[dict[str, Any]]) -> str:
    kept = [_mean(row["fresh"]["after"]["errors"]) <= row["budget"] for row in rows]
    costs = [row["fresh"][kind]["cpu_s_a_frame"] for row in rows for kind in ("after", "before")]
    ratios = [after / before for after, before in zip(costs[::2], costs[1::2], strict=True)]
    return (
        f"**The mean over fresh sequences is within the budget in {sum(kept)} of {len(kept)} cases, at "
        f"{min(ratios):.2f} to {max(ratios):.2f} of the cost of the job as it was.**"
    )


def table(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One line a scene and budget."""
    lines = []
    for row in rows:
        full, before, after = (row["fresh"][kind] for kind in ("full", "before", "after"))
        errors = (f"{100 * _mean(one['totals']):.1f}" for one in (full, before, after))
        lines.append(
            {
                "scene": row["scene"],
                "budget [%]": 100 * row["budget"],
                "taken, probes [%]": f"{100 * _mean(row['best']['errors']):.1f}",
                "taken, fresh [%]": _over(after["errors"]),
                "as it was, fresh [%]": _over(before["errors"]),
                "error, fresh: full, as it was, tuned [%]": ", ".join(errors),
                "CPU s a frame, as it was": before["cpu_s_a_frame"],
                "CPU s a frame, tuned": after["cpu_s_a_frame"],
                "cost ratio": after["cpu_s_a_frame"] / before["cpu_s_a_frame"],
                "changes": ", ".join(f"{key} {value}" for key, value in row["changes"].items()),
            }
        )
    return lines


def _mean(values: list[float | None]) -> float:
    """NaN where a sequence could not be carried out."""
    known = [value for value in values if value is not None]
    return sum(known) / len(values) if len(known) == len(values) else float("nan")


def _over(values: list[float | None]) -> str:
    """Mean over sequences with its interval, in percent."""
    if None in values:
        return "out of range"
    found = interval(100 * np.asarray(values, np.float64), np.random.default_rng(0))
    if not np.isfinite(found.low):  # too few, or all the same
        return f"{found.mean:.1f}"
    return f"{found.mean:.1f} [{found.low:.1f}, {found.high:.1f}]"


if __name__ == "__main__":
    typer.run(main)
