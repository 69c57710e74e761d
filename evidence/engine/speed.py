"""What the engine costs, and what a second worker brings."""

from __future__ import annotations

import json as json_
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.output import machine, write
from evidence.engine.trouble import timed
from synth.dataset.store import Dataset
from synth.engine import run, slots
from synth.engine.progress import Bars
from synth.job import reader


def speed(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")] = Path(
        "docs/results/engine/speed"
    ),
    job: Annotated[str, typer.Option(help="A job whose rendering is timed for the overhead.")] = "demo",
    rendered: Annotated[int, typer.Option(help="Sequences of it.")] = 8,
    sequences: Annotated[int, typer.Option(help="Stand-in sequences for one worker against two.")] = 24,
    cpu_s: Annotated[float, typer.Option(help="Processor time of each [s].")] = 4.0,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Overhead of engine and store over the bare stages, and two workers against one."""
    result: dict[str, Any] = {"overhead": overhead(job, rendered)}
    if sequences:
        stand_in = reader.load_job("tiny", [f"sequences={sequences}", "flow.backend=ideal"])
        load = os.getloadavg()[0]
        seconds = {n: timed(stand_in, "busy", n, cpu_s, 4.0)[1] for n in (1, 2)}
        result["workers"] = {
            "sequences": sequences,
            "scene_cpu_s": cpu_s,
            "seconds_1": round(seconds[1], 2),
            "seconds_2": round(seconds[2], 2),
            "ratio": round(seconds[1] / seconds[2], 3),
            "load_before": round(load, 2),
        }
    result["machine"] = machine.describe()
    write.keep(out, "speed.json", result)
    print(json_.dumps(result, indent=None if json else 1))


# The stages in one process and nothing else: no engine, no store, no index, no card.
_BARE = """
import sys
from pathlib import Path
from synth import pipeline
from synth.job.schema import Job
class Nowhere:
    def __init__(self, *_, **__): pass
    def __getattr__(self, name): return lambda *_, **__: None
pipeline.Writer = Nowhere
job = Job.model_validate_json(sys.argv[1])
for index in range(job.sequences):
    pipeline.render_sequence(job, index, Path("."), lambda *_: None)
"""


def overhead(name: str, count: int) -> dict[str, float | int]:
    """CPU time of a whole run (engine, workers, store, index, film, card) over that of its stages alone."""
    job = reader.load_job(name, [f"sequences={count}"])
    machine_words = {**os.environ, **slots.machine(job, 1), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as scratch, Bars() as bars:
        before = _cpu()
        words = [sys.executable, "-c", _BARE, job.model_dump_json()]
        subprocess.run(words, env=machine_words, cwd=scratch, check=True, stdout=subprocess.DEVNULL)
        bare = _cpu() - before
        before = _cpu()
        run.run_job(job, Path(scratch) / "out", run.Options(workers=1), bars)
        whole = _cpu() - before
        store = sum(
            sequence.attrs["timings"]["store"]["cpu_s"] for sequence in Dataset(Path(scratch) / "out")
        )
    return {
        "sequences": count,
        "whole_cpu_s": round(whole, 2),
        "stages_alone_cpu_s": round(bare, 2),
        "store_cpu_s": round(store, 2),
        "overhead": round(whole / bare - 1, 4),
        "store_share": round(store / bare, 4),
    }


def _cpu() -> float:
    mine, theirs = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return mine.ru_utime + mine.ru_stime + theirs.ru_utime + theirs.ru_stime
