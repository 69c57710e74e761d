"""Overhead of the engine over the bare stages, and speed-up by a second worker. 12 CPU-minutes."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from evidence import report
from evidence.study import Study
from synth.dataset.store import Dataset
from synth.engine import child, run
from synth.engine.journal import RunBars
from synth.job import reader
from synth.job.schema import Job


def measure(job: str = "demo", rendered: int = 8, sequences: int = 24) -> dict[str, Any]:
    """Overhead from `rendered` sequences of a job, speed-up by a second worker from `sequences` of it."""
    return {"overhead": overhead(job, rendered), "workers": workers(job, sequences, rendered)}


def page(found: Mapping[str, Any]) -> report.Page:
    """Overhead and speed-up against their targets."""
    over, two = found["overhead"], found["workers"]
    words = (
        f"**With two workers throughput is {two['ratio']:.2f} times that of one (target: at least 1.95; "
        f"{two['sequences']} sequences). Two processes without an engine reach {two['ratio_alone']:.2f} on "
        f"this machine. Engine, store, index and card add {over['overhead']:.1%} to the stages alone "
        f"(target: at most 5%), the store {over['store_share']:.1%}.**",
        "A random frame of 640 × 480 px with flow and traction takes 7.9 ms to read, all fields 17.4 ms; for "
        "100,000 sequences the status took 0.9 s, the report 1.3 s: measured earlier.",
    )
    sections = [report.Section(name, [found[name]]) for name in ("overhead", "workers")]
    return report.Page("Engine: overhead and workers", found, words, sections)


def overhead(name: str, count: int) -> dict[str, float | int]:
    """CPU time of a whole run (engine, store, index, preview, card) relative to its stages alone."""
    job = reader.load_job(name, [f"sequences={count}"])
    _render_alone(reader.load_job(name, ["sequences=1"]))  # compiles what later runs find in the cache
    bare = whole = store = 0.0
    with tempfile.TemporaryDirectory() as scratch, RunBars() as bars:
        for turn in range(2):  # alternately: the machine's speed drifts
            before = _cpu()
            _render_alone(job)
            between = _cpu()
            run.run_job(job, out := Path(scratch) / str(turn), run.Options(workers=1), bars)
            bare, whole = bare + between - before, whole + _cpu() - between
            store += sum(one.attrs["timings"]["store"]["cpu_s"] for one in Dataset(out))
    return {
        "sequences": 2 * count,
        "whole_cpu_s": whole,
        "stages_alone_cpu_s": bare,
        "store_cpu_s": store,
        "overhead": whole / bare - 1,
        "store_share": store / bare,
    }


def _render_alone(job: Job, processes: int = 1) -> float:
    """Wall time of a job's stages alone, in so many processes at once."""
    known = filter(None, [str(report.CHECKOUT), os.environ.get("PYTHONPATH")])
    path = {"PYTHONPATH": os.pathsep.join(known)}  # the module is found in any working directory
    threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    words = [sys.executable, "-m", "evidence.engine.bare", job.model_dump_json()]
    how: dict[str, Any] = {
        "env": os.environ | path | child.environment(job, 1) | threads,
        "stdout": subprocess.DEVNULL,
    }
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        started = [subprocess.Popen(words, cwd=scratch, **how) for _ in range(processes)]
        if any([one.wait() for one in started]):
            raise RuntimeError("the stages alone failed")
    return time.perf_counter() - began


def workers(name: str, count: int, alone: int) -> dict[str, float | int]:
    """Wall time of `count` sequences with one worker and with two, and how much two processes that render
    `alone` sequences each without an engine gain on this machine."""
    job, seconds = reader.load_job(name, [f"sequences={count}"]), {}
    for number in (1, 2):
        with tempfile.TemporaryDirectory() as scratch, RunBars() as bars:
            began = time.perf_counter()
            run.run_job(job, Path(scratch) / "out", run.Options(workers=number), bars)
            seconds[number] = time.perf_counter() - began
    times = {f"seconds_{number}": spent for number, spent in seconds.items()}
    few = reader.load_job(name, [f"sequences={alone}"])
    one, two = (_render_alone(few, processes) for processes in (1, 2))
    return {"sequences": count, **times, "ratio": seconds[1] / seconds[2], "ratio_alone": 2 * one / two}


def _cpu() -> float:
    return sum(os.times()[:4])  # of this process and its children


STUDY = Study(measure, "engine/speed.json", page)
