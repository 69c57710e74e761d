"""`bench experiment tune`: does `synth tune` keep its budget on fresh sequences, and what does it save?"""

from __future__ import annotations

import json as json_
import sys
import textwrap
from pathlib import Path
from typing import Annotated, Any

import typer

from bench import machine, plot
from synth import config, tune, tune_file
from synth.errors import UserError

_SCENES = ("easy", "middle", "hard")
_HOW = (
    "Seeds are in the jobs here; probe sequences are drawn from them, and the fresh ones had no part in the "
    "choice. Costs are of physics, scene, rendering and flow, in the same run."
)
_WHAT = (
    "The force is read from the displacement of a frame by a fixed linear rule "
    "(`synth/tune_reading.py`): the tangent of the physics at full fidelity, place, footprint and "
    "direction of each contact being known. *Error* is how far a job's reading, by its true and by its "
    "recovered displacement (the larger counts), is from that at full fidelity: root mean square over "
    "frames, mean over sequences. It holds what physics, surface, picture and flow do together; that "
    "the flow of the finest picture is itself not perfect is no part of it."
)


def experiment(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder that holds the scenes' jobs and gets the results.")
    ] = Path("docs/results/tune"),
    budget: Annotated[str, typer.Option(help="As in `synth tune`.")] = "force 3%",
    probes: Annotated[int, typer.Option(min=1, help="Sequences that every knob is measured on.")] = 3,
    checks: Annotated[int, typer.Option(min=0, help="Further ones for whole settings.")] = 3,
    fresh: Annotated[int, typer.Option(min=1, help="Sequences that had no part in the choice.")] = 4,
    only: Annotated[
        list[str] | None, typer.Option(help="Scenes; easy, middle and hard if not given.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Tunes three scenes of different difficulty and checks budget and cost on fresh sequences."""
    asked = tune.Budget.parse(budget)
    for name in only or _SCENES:
        source = out / f"{name}.yaml"
        if not source.is_file():
            raise UserError(f"{source}: no such scene")
        job = config.load(str(source))
        say = _said(name)
        found = tune.run(job, asked, out / f"{name}.part", probes, checks, say)
        before, after = tune.again(found, out / f"{name}.fresh.part", probes + checks, fresh, say)
        tuned = out / f"{name}.tuned.yaml"
        tuned.unlink(missing_ok=True)
        tune_file.write(found, str(source), (), tuned)
        row = tune_file.as_dict(found) | {
            "scene": name,
            "frames": job.frames,
            "fresh": {
                "before": list(before.errors),
                "after": list(after.errors),
                "before_cpu_s": before.cost,
                "after_cpu_s": after.cost,
            },
            "machine": machine.describe(),
            "command": f"bench experiment tune --only {name} --budget '{budget}' --probes {probes} "
            f"--checks {checks} --fresh {fresh}",
        }
        (out / f"{name}.json").write_text(json_.dumps(row, indent=1) + "\n", "utf-8")
    rows = [
        json_.loads((out / f"{name}.json").read_text("utf-8"))
        for name in _SCENES
        if (out / f"{name}.json").is_file()
    ]
    commands = "; ".join(row["command"] for row in rows)
    title = "Tuning: what each knob does to the force, and what it costs"
    plot.write(panels(rows), out, title, table(rows), rows[0] | {"command": commands})
    (out / "README.md").write_text(readme(rows), "utf-8")
    if json:
        print(json_.dumps(rows))
    else:
        print(out / "README.md")


def panels(rows: list[dict[str, Any]]) -> list[plot.Panel]:
    """A chart a scene: error of the force over cost, each knob alone and whole settings."""
    made = []
    for row in rows:
        curves = []
        for knob in dict.fromkeys(one["knob"] for one in row["knobs"]):
            own = [one for one in row["knobs"] if one["knob"] == knob and one["error"] is not None]
            curves.append(
                plot.Curve(
                    knob,
                    tuple(row["full"]["cpu_s_a_frame"] * (1 - one["saved"]) for one in own),
                    tuple(100 * one["error"] for one in own),
                    tuple(f"{one['level']}" for one in own),
                )
            )
        whole = [("the job as it was", row["own"]), ("tuned", row["tried"][-1])]
        curves.append(
            plot.Curve(
                "whole job",
                tuple(one["cpu_s_a_frame"] for _, one in whole),
                tuple(100 * one["error"] for _, one in whole),
                tuple(words for words, _ in whole),
                ringed=(1,),
            )
        )
        title = f"{row['scene']}: error of the force over cost"
        made.append(plot.Panel(title, "CPU s a frame", "force moves by [%]", tuple(curves)))
    return made


def table(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One line a scene."""
    lines = []
    for row in rows:
        fresh, best = row["fresh"], row["tried"][-1]
        lines.append(
            {
                "scene": row["scene"],
                "budget [%]": 100 * row["budget"],
                "probes: tuned [%]": 100 * best["error"],
                "fresh: tuned [%]": 100 * _mean(fresh["after"]),
                "fresh: as it was [%]": 100 * _mean(fresh["before"]),
                "CPU s a frame, as it was": fresh["before_cpu_s"],
                "CPU s a frame, tuned": fresh["after_cpu_s"],
                "cost ratio": fresh["after_cpu_s"] / fresh["before_cpu_s"],
                "changes": ", ".join(f"{key} {value}" for key, value in row["changes"].items()),
            }
        )
    return lines


def readme(rows: list[dict[str, Any]]) -> str:
    """What was asked and what came out."""
    lines = [
        "# Tuning: no more than a scene needs",
        "",
        *(f"    {row['command']}" for row in rows),
        "",
        *textwrap.wrap(f"Machine: {machine.line(rows[0]['machine'])}. {_HOW}", 110),
        "",
        *textwrap.wrap(_WHAT, 110),
        "",
        "![What each knob does](chart.svg)",
        "",
    ]
    cells = [
        {key: f"{value:.3g}" if isinstance(value, float) else str(value) for key, value in one.items()}
        for one in table(rows)
    ]
    lines += [f"| {' | '.join(cells[0])} |", "|" + " --- |" * len(cells[0])]
    lines += [f"| {' | '.join(one.values())} |" for one in cells]
    for row in rows:
        lines += ["", f"## {row['scene']}", "", "| knob | level | force moves by | saves of a full frame |"]
        lines.append("|" + " --- |" * 4)
        for one in row["knobs"]:
            error = "out of range" if one["error"] is None else f"{100 * one['error']:.2g}%"
            lines.append(f"| {one['knob']} | {one['level']} | {error} | {100 * one['saved']:.0f}% |")
        lines += ["", "Measured as a whole:", ""]
        for name, one in [
            ("as it was", row["own"]),
            *((f"try {k}", t) for k, t in enumerate(row["tried"], 1)),
        ]:
            said = ", ".join(f"{key} {value}" for key, value in one["setting"].items())
            promised = "" if one["promised"] is None else f", {100 * one['promised']:.2g}% promised"
            error = "out of range" if one["error"] is None else f"{100 * one['error']:.2g}%"
            lines.append(f"- {name}: {error}{promised}, {one['cpu_s_a_frame']:.2f} CPU-s a frame ({said})")
    return "\n".join(lines) + "\n"


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def _said(scene: str) -> tune.Report:
    def say(done: int, total: int, words: str) -> None:
        print(f"{scene} [{done}/{total}] {words}", file=sys.stderr, flush=True)

    return say
