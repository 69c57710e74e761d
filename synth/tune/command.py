"""`synth tune`: heavy imports are inside, as in `cli`."""

from __future__ import annotations

import json as json_
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

# CPU-s of a picture at full fidelity, its flow included, and of a scene; measured on one core at 640 x 480.
_PIXEL_S, _SCENE_S = 5e-6, 10.0


def tune(
    job: Annotated[str, typer.Argument(help="A job file, or a named job: tiny, demo, paper.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(help="Changes to the job, as section.key=value.")
    ] = None,
    budget: Annotated[
        str,
        typer.Option(help="By how much the error of the force may grow over full fidelity's: 'force 3%'."),
    ] = "force 3%",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The job to write; JOB.tuned.yaml if not given.")
    ] = None,
    probes: Annotated[int, typer.Option(min=1, max=50, help="Sequences that every knob is measured on.")] = 3,
    checks: Annotated[int, typer.Option(min=0, max=50, help="Further sequences for whole settings.")] = 3,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Writes the cheapest job whose error of the force is within a budget of full fidelity's.

    A few probe sequences are computed at full fidelity and with each knob turned (law, mesh, time step,
    surface, size of picture, paths, lens, highlights, flow's warps); the setting chosen is measured as a
    whole. A run that was stopped goes on when it is given again.
    """
    from synth.errors import UserError
    from synth.job import reader
    from synth.tune import knobs, tuned_job
    from synth.tune import search as tuning
    from synth.tune.probe import LOADED

    asked = tuning.Budget.parse(budget)
    read = reader.load_job(job, overrides or [])
    target = out or Path(f"{Path(job).stem}.tuned.yaml")
    if target.exists():
        raise UserError(f"{target}: exists already")
    if not target.resolve().parent.is_dir():
        raise UserError(f"{target}: its folder does not exist")
    levels = sum(len(knob.levels) for knob in knobs.list_knobs(read))
    width, height = read.render.size
    each = _SCENE_S + (LOADED + 1) * width * height * _PIXEL_S
    # Most levels are compared at half the picture's width.
    minutes = (probes * levels * 0.4 + 4 * (probes + checks)) * each / 60
    print(
        f"{levels} levels of {len(knobs.list_knobs(read))} knobs on {probes} sequences, whole settings on "
        f"{probes + checks}: about {minutes:.0f} CPU-minutes; a run that is stopped goes on",
        file=sys.stderr,
    )
    journal = target.with_name(target.name + ".part")
    if journal.is_symlink():
        raise UserError(f"{journal}: is a link, which is not followed; remove it")
    found = tuning.tune_job(read, asked, journal, probes, checks, _said())
    tuned_job.write_tuned(found, job, overrides or [], target)
    journal.unlink(missing_ok=True)
    if json:
        print(json_.dumps(tuned_job.as_dict(found) | {"out": str(target)}))
        return
    print("\n".join([*tuned_job.summary(found), "", *tuned_job.lines(found), "", f"wrote {target}"]))


def _said() -> Callable[[int, int, str], None]:
    """A line on stderr for each measurement, with what is left at the rate so far."""
    from synth.engine.progress import clock

    began = time.monotonic()

    def say(done: int, total: int, words: str) -> None:
        left = clock((time.monotonic() - began) / done * (total - done))
        print(f"[{done}/{total}, {left} left] {words}", file=sys.stderr, flush=True)

    return say
