"""Thirty scenes of which one aborts its process and one takes all memory: what do the others lose?"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from evidence.engine import work as stand_in
from evidence.measuring import measuring
from synth.engine import run
from synth.engine.progress import Bars
from synth.engine.run import Options, Summary
from synth.job.schema import Job


@measuring(
    "--sequences 6 --out runs/trouble",
    out="docs/results/engine/trouble",
    file="trouble.json",
    passed=lambda found: (
        found["done_without_trouble"] == found["sequences"] and found["done"] == found["sequences"] - 2
    ),
)
def trouble(
    sequences: Annotated[int, typer.Option(help="Scenes.")] = 30,
    workers: Annotated[int, typer.Option(help="Worker processes.")] = 2,
    memory_gb: Annotated[float, typer.Option(help="Memory a process may take.")] = 1.0,
    cpu_s: Annotated[float, typer.Option(help="Processor time of the stand-in a scene [s].")] = 4.0,
) -> dict[str, Any]:
    """Runs a job with two bad scenes and one without, and compares what is done and how long it takes."""
    picture = {"render": {"size": (64, 48)}, "flow": {"backend": "ideal"}}
    job = Job.model_validate({"seed": 1, "sequences": sequences, "frames": 5, **picture})
    good, good_s = timed(job, "busy", workers, cpu_s, memory_gb)
    bad, bad_s = timed(job, "troubled", workers, cpu_s, memory_gb)
    return {
        "sequences": sequences,
        "workers": workers,
        "scene_cpu_s": cpu_s,
        "done_without_trouble": good.done,
        "done": bad.done,
        "failed": bad.failed,
        "seconds_without_trouble": round(good_s, 2),
        "seconds_with_trouble": round(bad_s, 2),
        "ratio": round(bad_s / good_s, 3),
    }


def timed(job: Job, work: str, workers: int, cpu_s: float, memory_gb: float) -> tuple[Summary, float]:
    """A run of the stand-in in a folder of its own, and the seconds it took by the clock."""
    options = Options(
        workers=workers,
        memory_gb=memory_gb,
        work=f"evidence.engine.work:{work}",
        environment=stand_in.environment(STAND_IN_CPU_S=cpu_s),
    )
    with tempfile.TemporaryDirectory() as scratch, Bars() as bars:
        begun = time.perf_counter()
        summary = run.run_job(job, Path(scratch) / "out", options, bars)
        return summary, time.perf_counter() - begun
