"""Overhead of the engine over the bare stages, and speed-up by a second worker. 10 CPU-minutes."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest import mock

from evidence import report
from evidence.study import Study
from synth.dataset.store import Dataset
from synth.engine import child, run
from synth.engine.journal import RunBars
from synth.job import reader
from synth.job.schema import Job


def measure(job: str = "demo", rendered: int = 8, sequences: int = 24) -> dict[str, Any]:
    """Overhead from `rendered` sequences of a job, speed-up by a second worker from `sequences` of it."""
    return {"overhead": overhead(job, rendered), "workers": workers(job, sequences)}


def page(found: Mapping[str, Any]) -> report.Page:
    """Overhead and speed-up against their targets."""
    over, two = found["overhead"], found["workers"]
    words = (
        f"**With two workers throughput is {two['ratio']:.2f} times that of one (target: at least 1.8; "
        f"{two['sequences']} sequences). Engine, store, index and card add "
        f"{over['overhead']:.1%} to the stages alone (target: at most 8%), "
        f"the store {over['store_share']:.1%}.**",
    )
    sections = [report.Section(name, [found[name]]) for name in ("overhead", "workers")]
    return report.Page("Engine: overhead and workers", found, (), sections, words)


def overhead(name: str, count: int) -> dict[str, float | int]:
    """CPU time of a whole run (engine, store, index, preview, card) relative to its stages alone."""
    job = reader.load_job(name, [f"sequences={count}"])
    known = filter(None, [str(report.CHECKOUT), os.environ.get("PYTHONPATH")])
    path = {"PYTHONPATH": os.pathsep.join(known)}  # this module is found in any working directory
    threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    alone = os.environ | path | child.environment(job, 1) | threads
    program = "import sys; from evidence.engine.speed import render_bare; render_bare(sys.argv[1])"
    with tempfile.TemporaryDirectory() as scratch, RunBars() as bars:
        before = _cpu()
        words = [sys.executable, "-c", program, job.model_dump_json()]
        subprocess.run(words, env=alone, cwd=scratch, check=True, stdout=subprocess.DEVNULL)
        bare = _cpu() - before
        before = _cpu()
        run.run_job(job, Path(scratch) / "out", run.Options(workers=1), bars)
        whole = _cpu() - before
        store = sum(one.attrs["timings"]["store"]["cpu_s"] for one in Dataset(Path(scratch) / "out"))
    return {
        "sequences": count,
        "whole_cpu_s": whole,
        "stages_alone_cpu_s": bare,
        "store_cpu_s": store,
        "overhead": whole / bare - 1,
        "store_share": store / bare,
    }


class _Nowhere:
    """Accepts every call of a store and stores nothing."""

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


def workers(name: str, count: int) -> dict[str, float | int]:
    """Wall time of a job's sequences with one worker and with two."""
    job, seconds = reader.load_job(name, [f"sequences={count}"]), {}
    for number in (1, 2):
        with tempfile.TemporaryDirectory() as scratch, RunBars() as bars:
            began = time.perf_counter()
            run.run_job(job, Path(scratch) / "out", run.Options(workers=number), bars)
            seconds[number] = time.perf_counter() - began
    times = {f"seconds_{number}": spent for number, spent in seconds.items()}
    return {"sequences": count, **times, "ratio": seconds[1] / seconds[2]}


def _cpu() -> float:
    return sum(os.times()[:4])  # of this process and its children


STUDY = Study(measure, "engine/speed.json", page)
