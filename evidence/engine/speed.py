"""What the engine costs, and what a second worker brings."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import typer

from evidence.engine import work
from evidence.engine.trouble import timed
from evidence.measuring import measuring
from synth.dataset.store import Dataset
from synth.engine import run, slots
from synth.engine.progress import Bars
from synth.job import reader
from synth.job.schema import Job


@measuring("--rendered 4 --out runs/speed", out="docs/results/engine/speed", file="speed.json")
def speed(
    job: Annotated[str, typer.Option(help="A job whose rendering is timed for the overhead.")] = "demo",
    rendered: Annotated[int, typer.Option(help="Sequences of it.")] = 8,
    sequences: Annotated[int, typer.Option(help="Stand-in sequences for one worker against two.")] = 24,
    cpu_s: Annotated[float, typer.Option(help="Processor time of each [s].")] = 4.0,
) -> dict[str, Any]:
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
    return result


class _Nowhere:
    """Takes what a store takes, and keeps nothing."""

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: None


def render_bare(described: str) -> None:
    """The stages in one process and nothing else: no engine, no store, no index, no card."""
    from synth.sequence import pipeline

    job = Job.model_validate_json(described)
    with mock.patch.object(pipeline, "Writer", _Nowhere):
        for index in range(job.sequences):
            pipeline.render_sequence(job, index, Path("."), lambda *_: None)


def overhead(name: str, count: int) -> dict[str, float | int]:
    """CPU time of a whole run (engine, workers, store, index, film, card) over that of its stages alone."""
    job = reader.load_job(name, [f"sequences={count}"])
    alone = {**os.environ, **work.environment(), **slots.machine(job, 1)}
    alone |= {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    program = "import sys; from evidence.engine.speed import render_bare; render_bare(sys.argv[1])"
    with tempfile.TemporaryDirectory() as scratch, Bars() as bars:
        before = _cpu()
        words = [sys.executable, "-c", program, job.model_dump_json()]
        subprocess.run(words, env=alone, cwd=scratch, check=True, stdout=subprocess.DEVNULL)
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
