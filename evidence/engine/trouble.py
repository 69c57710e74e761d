"""Thirty scenes of which one aborts its process and one takes all memory: what do the others lose?"""

from __future__ import annotations

import json as json_
import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer

from bench.output import machine, write
from synth.engine import run
from synth.engine.progress import Bars
from synth.engine.run import Options, Summary
from synth.job.schema import Job


def trouble(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")] = Path(
        "docs/results/engine/trouble"
    ),
    sequences: Annotated[int, typer.Option(help="Scenes.")] = 30,
    workers: Annotated[int, typer.Option(help="Worker processes.")] = 2,
    memory_gb: Annotated[float, typer.Option(help="Memory a process may take.")] = 1.0,
    cpu_s: Annotated[float, typer.Option(help="Processor time of the stand-in a scene [s].")] = 4.0,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Runs a job with two bad scenes and one without, and compares what is done and how long it takes."""
    picture = {"render": {"size": (64, 48)}, "flow": {"backend": "ideal"}}
    job = Job.model_validate({"seed": 1, "sequences": sequences, "frames": 5, **picture})
    good, good_s = timed(job, "busy", workers, cpu_s, memory_gb)
    bad, bad_s = timed(job, "troubled", workers, cpu_s, memory_gb)
    result = {
        "sequences": sequences,
        "workers": workers,
        "scene_cpu_s": cpu_s,
        "done": bad.done,
        "failed": bad.failed,
        "seconds_without_trouble": round(good_s, 2),
        "seconds_with_trouble": round(bad_s, 2),
        "ratio": round(bad_s / good_s, 3),
        "machine": machine.describe(),
    }
    write.keep(out, "trouble.json", result)
    text = f"{bad.done} done, {len(bad.failed)} failed, {result['ratio']} times the time"
    print(json_.dumps(result) if json else text)
    if good.done != sequences or bad.done != sequences - 2:
        raise typer.Exit(1)


def timed(job: Job, work: str, workers: int, cpu_s: float, memory_gb: float) -> tuple[Summary, float]:
    """A run of the stand-in in a folder of its own, and the seconds it took by the clock."""
    options = Options(
        workers=workers,
        memory_gb=memory_gb,
        work=f"evidence.engine.work:{work}",
        environment={"STAND_IN_CPU_S": str(cpu_s)},
    )
    with tempfile.TemporaryDirectory() as scratch, Bars() as bars:
        begun = time.perf_counter()
        summary = run.run_job(job, Path(scratch) / "out", options, bars)
        return summary, time.perf_counter() - begun
