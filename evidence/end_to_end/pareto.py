"""`bench pareto end-to-end`: error of the force against cost, for whole pipelines from physics to model.

A pipeline makes sequences (law, mesh, paths), recovers their flow and fits a model on them; it is asked for
the force of sequences that a finer pipeline made of scenes it has not seen, from the flow that its own
estimator recovers there. Its cost is the CPU time of one frame of its data and of one answer.

What is asked is restricted to one instrument that pulls or pushes: flow shows the force along the line of
sight only through the little that tissue spreads under a push, and a grasp's two jaws gather it as well. On
recovered flow hardly anything of that part is learnt (`along` in the results): so the part across the line of
sight is judged by itself besides.
"""

from __future__ import annotations

import json as json_
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from bench.output import machine, result_page, write
from evidence.end_to_end import costs as end_to_end_costs
from evidence.end_to_end import page
from evidence.end_to_end.costs import Costs
from evidence.end_to_end.pipelines import FINE, FRAMES, SIZE, Pipeline, Sequences, Trial, chosen, errors
from evidence.measuring import measuring
from learn.evaluation.statistics import interval, paired
from synth.job.schema import Flow

PARTS = {"": "errors", "across_": "across"}
"""What defaults are judged by: the whole force, and its part across the line of sight. Prefix of the names in
a row, and the errors by sequence."""


@measuring("--fit 8 --test 6 --out runs/end-to-end")
def pareto(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results.")] = Path(
        "docs/results/end-to-end"
    ),
    work: Annotated[
        Path,
        typer.Option(
            help="Folder for sequences, flow and answers; what is there already is used, if the same job, "
            "generator and estimator made it."
        ),
    ] = Path("runs/end-to-end-work"),
    fit: Annotated[int, typer.Option(min=4, help="Sequences that each pipeline makes to fit on.")] = 40,
    test: Annotated[int, typer.Option(min=3, help="Sequences that all are asked about.")] = 24,
    seed: Annotated[int, typer.Option(min=0, help="Root of every draw.")] = 31,
    epochs: Annotated[int, typer.Option(min=1, help="Of the network.")] = 60,
    rounds: Annotated[
        int, typer.Option(min=2, help="How often everything is timed, in turn, once the answers are there.")
    ] = 4,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Error of the force against CPU time a frame, for whole pipelines: law, mesh, paths, flow and model."""

    def say(line: str) -> None:
        if not json:
            typer.echo(line)

    asked = Sequences(FINE, FINE.job(seed + 1, test), work)
    pipelines, trial = chosen(), Trial(epochs, seed, work)
    worlds = dict.fromkeys(one.world for one in pipelines)
    made = {world: Sequences(world, world.job(seed, fit), work) for world in worlds}
    rows: list[dict[str, Any]] = []
    for one in pipelines:
        rows.append(one.words() | trial.errors(one, made[one.world], asked))
        say(f"{len(rows)} of {len(pipelines)}: {one.name}, {100 * np.mean(rows[-1]['errors']):.0f}%")
    costs = end_to_end_costs.measure(
        {world.name: world.job(seed, fit) for world in made},
        [flow for flow in dict.fromkeys(one.flow for one in pipelines) if flow != "ideal"],
        {one.model: trial.fit(one, made[one.world]) for one in pipelines if one.default},
        asked.clips(Flow().backend),
        work,
        rounds,
        say,
    )
    priced = [row | price(one, costs) for one, row in zip(pipelines, rows, strict=True)]
    still = [clip.force for clip in asked.clips("ideal")]
    nothing = {key: float(np.mean(v)) for key, v in errors([0 * f for f in still], still).items()}
    found = {
        "command": f"bench pareto end-to-end --fit {fit} --test {test} --seed {seed} --epochs {epochs} "
        f"--rounds {rounds}",
        "machine": machine.describe(),
        "meaning": f"{SIZE[0]} x {SIZE[1]} px, {FRAMES} frames, one instrument that pulls or pushes; "
        "cpu_s: of a frame of data (physics, scene, rendering, flow) and of one answer, the least of "
        f"{rounds} rounds in which everything was timed in turn; errors: of the force's three components "
        "together, root mean square over frames as a part of the force's own, by sequence; across, along: "
        "the parts of it across and along the line of sight, whose squares add up in every sequence",
        "asked": asdict(FINE),
        "zero": nothing["errors"],
        "across_zero": nothing["across"],
        "rows": summarised(priced, seed),
        "rounds": costs.rounds,
    }
    write.keep(out, "pareto.json", found)
    result_page.write(page.drawn(found), out)
    typer.echo(json_.dumps(found) if json else str(out / "README.md"))


def price(one: Pipeline, costs: Costs) -> dict[str, float]:
    """CPU time [s] of a frame of a pipeline's data, of its flow, of its answer; and of all three."""
    parts = {"data_s": costs.data[one.world.name], "flow_s": costs.flow[one.flow]}
    parts["answer_s"] = costs.answer[one.model]
    return parts | {"cpu_s": sum(parts.values())}


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
