"""`bench experiment tune`: does `synth tune` keep its budget on fresh sequences, and what does it save?"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from bench.output import charts, machine, result_page
from bench.output import write as results
from evidence.measuring import measuring
from learn.evaluation.statistics import interval
from synth.errors import UserError
from synth.job import reader
from synth.tune import search, tuned_job

_SCENES = ("easy", "middle", "hard")
_HOW = (
    "Seeds are in the jobs here; probe sequences are drawn from them, and the fresh ones had no part in the "
    "choice. Costs are of physics, scene, rendering and flow, in CPU time; what two "
    "budgets share is measured once."
)
_WHAT = (
    "The force is read from the displacement of a frame by a fixed linear rule "
    "(`synth/tune/force_reading.py`): the tangent of the physics at full fidelity, place, footprint and "
    "direction of each contact being known. *Error* is how far the force read from recovered displacement "
    "is off the truth of full fidelity: root mean square over frames as a part of the force, mean over "
    "sequences. A setting *takes* of the budget by how much that is more than at full fidelity, or by how "
    "much the label itself moves, whichever is more; a sequence that reads better than at full fidelity "
    "takes nothing and pays for no other. *Apart* is how far the two readings are from each other, frame by "
    "frame: grain that differs counts there, though neither picture is the better one. The intervals are "
    "over the fresh sequences."
)


@measuring(
    "--only easy --fresh 3",
    out="docs/results/tune",
    said="Folder that holds the scenes' jobs and gets the results.",
    text="README.md",
)
def experiment(
    out: Path,
    budget: Annotated[
        list[str] | None, typer.Option(help="As in `synth tune`; 'force 5%' and 'force 3%' if not given.")
    ] = None,
    probes: Annotated[int, typer.Option(min=1, help="Sequences that every knob is measured on.")] = 3,
    checks: Annotated[int, typer.Option(min=0, help="Further ones for whole settings.")] = 3,
    fresh: Annotated[int, typer.Option(min=3, help="Sequences that had no part in the choice.")] = 6,
    only: Annotated[
        list[str] | None, typer.Option(help="Scenes; easy, middle and hard if not given.")
    ] = None,
) -> list[dict[str, Any]]:
    """Tunes three scenes of different difficulty and checks budget and cost on fresh sequences."""
    budgets = budget or ["force 5%", "force 3%"]
    asked = [search.Budget.parse(one) for one in budgets]
    words = " ".join(f"--budget {one!r}" for one in budgets)
    scenes = list(only or _SCENES)
    if unknown := [name for name in scenes if name not in _SCENES]:
        raise UserError(f"--only {unknown[0]}: no such scene; there are {', '.join(_SCENES)}")
    jobs = {name: reader.load_job(str(out / f"{name}.yaml")) for name in scenes}
    for name, job in jobs.items():
        source, say = out / f"{name}.yaml", _said(name)
        # One budget after the other finds what was measured for the one before.
        journals = out / f"{name}.part", out / f"{name}.fresh.part"
        for one in asked:
            found = search.tune_job(job, one, journals[0], probes, checks, say)
            fresh_ones = search.measure_again(found, journals[1], probes + checks, fresh, say)
            stem = f"{name}-{100 * one.share:g}"
            (out / f"{stem}.tuned.yaml").unlink(missing_ok=True)
            tuned_job.write_tuned(found, str(source), (), out / f"{stem}.tuned.yaml")
            row = tuned_job.as_dict(found) | {
                "scene": name,
                "frames": job.frames,
                "fresh": {
                    kind: tuned_job.whole(found, whole)
                    for kind, whole in zip(("full", "before", "after"), fresh_ones, strict=True)
                },
                "machine": machine.describe(),
                "command": f"bench experiment tune --only {name} {words} --probes {probes} "
                f"--checks {checks} --fresh {fresh}",
            }
            results.keep(out, f"{stem}.json", row)
        for journal in journals:
            journal.unlink(missing_ok=True)
    return write_results(out)


def write_results(out: Path) -> list[dict[str, Any]]:
    """Picture and README of the scenes whose data are in `out`; gives those back."""
    result_page.write(drawn(out), out)
    return read(out)


def drawn(out: Path) -> result_page.Page:
    """What the data in `out` say."""
    rows = read(out)
    sections = [result_page.Section("", table(rows))]
    for row in rows:
        knobs = [
            {
                "knob": one["knob"],
                "level": one["level"],
                "error of the force": _percent(one["change"], "+"),
                "takes of the budget": _percent(one["error"]),
                "saves of a full frame": f"{100 * one['saved']:.0f}%",
            }
            for one in row["knobs"]
        ]
        tried = [("as it was", row["own"]), *((f"try {k}", one) for k, one in enumerate(row["tried"], 1))]
        whole = [
            {
                "measured as a whole": name,
                "takes": _percent(one["error"]),
                "promised": None if one["promised"] is None else f"{100 * one['promised']:.2g}%",
                "CPU s a frame": f"{one['cpu_s_a_frame']:.2f}",
                "setting": ", ".join(f"{key} {value}" for key, value in one["setting"].items()),
            }
            for name, one in tried
        ]
        title = f"{row['scene']}, {100 * row['budget']:g}%"
        sections += [result_page.Section(title, knobs), result_page.Section("", whole)]
    return result_page.Page(
        "Tuning: what each knob does to the force, and what it costs",
        rows[0] | {"command": "; ".join(dict.fromkeys(row["command"] for row in rows))},
        panels(rows),
        sections,
        (_HOW, _WHAT),
        name="README.md",
    )


def read(out: Path) -> list[dict[str, Any]]:
    """The data in `out`, scene by scene, the loosest budget first."""
    files = [file for name in _SCENES for file in out.glob(f"{name}-*.json")]
    rows = [json.loads(file.read_text("utf-8")) for file in files]
    return sorted(rows, key=lambda row: (_SCENES.index(row["scene"]), -row["budget"]))


def panels(rows: list[dict[str, Any]]) -> list[charts.Panel]:
    """A chart a scene: error of the force over cost, each knob alone and whole settings."""
    made = []
    for row in rows:
        curves, base = [], _mean(row["full"]["totals"])
        for knob in dict.fromkeys(one["knob"] for one in row["knobs"]):
            own = [one for one in row["knobs"] if one["knob"] == knob and one["error"] is not None]
            curves.append(
                charts.Curve(
                    knob,
                    tuple(row["full"]["cpu_s_a_frame"] * (1 - one["saved"]) for one in own),
                    tuple(100 * (base + one["change"]) for one in own),
                    tuple(f"{one['level']}" for one in own),
                )
            )
        whole = [("full", row["full"]), ("the job as it was", row["own"]), ("tuned", row["best"])]
        curves.append(
            charts.Curve(
                "whole job",
                tuple(one["cpu_s_a_frame"] for _, one in whole),
                tuple(100 * _mean(one["totals"]) for _, one in whole),
                tuple(words for words, _ in whole),
                ringed=(2,),
            )
        )
        title = f"{row['scene']}, {100 * row['budget']:g}%: error of the force over cost"
        made.append(charts.Panel(title, "CPU s a frame", "error of the force [%]", tuple(curves)))
    return made


def table(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One line a scene."""
    lines = []
    for row in rows:
        fresh, best = row["fresh"], row["best"]
        lines.append(
            {
                "scene": row["scene"],
                "budget [%]": 100 * row["budget"],
                "taken, probes [%]": f"{100 * best['error']:.1f}",
                "taken, fresh [%]": _over(fresh["after"]["errors"]),
                "as it was, fresh [%]": _over(fresh["before"]["errors"]),
                "error, fresh: full, as it was, tuned [%]": ", ".join(
                    f"{100 * _mean(fresh[name]['totals']):.1f}" for name in ("full", "before", "after")
                ),
                "apart, fresh: as it was, tuned [%]": ", ".join(
                    f"{100 * _mean(fresh[name]['apart']):.1f}" for name in ("before", "after")
                ),
                "CPU s a frame, as it was": fresh["before"]["cpu_s_a_frame"],
                "CPU s a frame, tuned": fresh["after"]["cpu_s_a_frame"],
                "cost ratio": fresh["after"]["cpu_s_a_frame"] / fresh["before"]["cpu_s_a_frame"],
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
    return f"{found.mean:.1f} [{found.low:.1f}, {found.high:.1f}]"


def _percent(share: float | None, sign: str = "") -> str:
    return "out of range" if share is None else f"{100 * share:{sign}.2g}%"


def _said(scene: str) -> search.Report:
    def say(done: int, total: int, words: str) -> None:
        print(f"{scene} [{done}/{total}] {words}", file=sys.stderr, flush=True)

    return say
