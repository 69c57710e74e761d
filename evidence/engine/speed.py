"""Overhead of the engine over the bare stages, and speed-up by a second worker. 10 CPU-minutes."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from evidence import report
from evidence.study import Study
from synth.dataset.store import Dataset, Writer
from synth.engine import machine, run
from synth.engine.progress import RunBars
from synth.job import reader
from synth.job.schema import Job
from synth.system.stopwatch import StageCallback

_CPU_S = "STAND_IN_CPU_S"  # environment variable: how long a stand-in computes in a worker [s]


def measure(job: str = "demo", rendered: int = 8, sequences: int = 24, cpu_s: float = 4.0) -> dict[str, Any]:
    """Overhead from `rendered` sequences of a job; workers from stand-ins of `cpu_s` processor time each."""
    return {"overhead": overhead(job, rendered), "workers": workers(sequences, cpu_s)}


def page(found: Mapping[str, Any]) -> report.Page:
    """Overhead and speed-up against their targets."""
    over, two = found["overhead"], found["workers"]
    words = (
        f"**With two workers throughput is {two['ratio']:.2f} times that of one (target: at least 1.8; "
        f"{two['sequences']} stand-ins of {two['scene_cpu_s']:g} CPU-s). Engine, store, index and card add "
        f"{over['overhead']:.1%} to the stages alone (target: at most 8%), "
        f"the store {over['store_share']:.1%}.**",
        "Kills, damage, faults and Dask are tested in `tests/slow`. Earlier measurements, by code in git's "
        "history: 200 SIGKILLs over 50 sequences, and 50 over 12 rendered ones, left equal bytes (6dd5d3e, "
        "bad03fb); a random frame of 640 × 480 px with flow and traction takes 7.9 ms to read, all fields "
        "17.4 ms; for 100,000 sequences the status took 0.9 s, the report 1.3 s (22268e1).",
    )
    sections = [report.Section(name, [found[name]]) for name in ("overhead", "workers")]
    return report.Page("Engine: overhead and workers", found, (), sections, words)


def overhead(name: str, count: int) -> dict[str, float | int]:
    """CPU time of a whole run (engine, store, index, preview, card) relative to its stages alone."""
    job = reader.load_job(name, [f"sequences={count}"])
    alone = {
        **os.environ,
        **_path(),
        **machine.environment(job, 1),
        "OMP_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
    }
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


def workers(sequences: int, cpu_s: float) -> dict[str, float | int]:
    """Wall time of stand-in sequences with one worker and with two."""
    job = reader.load_job("tiny", [f"sequences={sequences}", "flow.backend=ideal"])
    seconds = {}
    for count in (1, 2):
        environment = {**_path(), _CPU_S: str(cpu_s)}
        options = run.Options(workers=count, work="evidence.engine.speed:compute", environment=environment)
        with tempfile.TemporaryDirectory() as scratch, RunBars() as bars:
            began = time.perf_counter()
            run.run_job(job, Path(scratch) / "out", options, bars)
            seconds[count] = time.perf_counter() - began
    return {
        "sequences": sequences,
        "scene_cpu_s": cpu_s,
        "seconds_1": seconds[1],
        "seconds_2": seconds[2],
        "ratio": seconds[1] / seconds[2],
    }


def compute(job: Job, index: int, folder: Path, progress: StageCallback) -> None:
    """A stand-in for rendering: arithmetic for a given CPU time, then a store of random fields."""
    rng = np.random.default_rng((job.seed, index))
    matrix = rng.normal(size=(200, 200))
    until = time.process_time() + float(os.environ[_CPU_S])
    while time.process_time() < until:
        np.linalg.svd(matrix)
    size = job.render.size[::-1]
    writer = Writer(folder, index, frames=job.frames, size=size, job=job)
    writer.put("time", np.arange(job.frames) / job.fps)
    writer.put("force", rng.normal(size=(job.frames, 3)))
    writer.put("tissue", rng.random(size) > 0.2)
    writer.put("area", rng.random(size))
    for t in range(job.frames):
        progress("render", t, job.frames)
        writer.put_frame("rgb", t, rng.integers(0, 256, (*size, 3)).astype(np.uint8))
        for name in ("visible", "tool", "glare"):
            writer.put_frame(name, t, rng.random(size) > 0.5)
        writer.put_frame("flow", t, rng.normal(size=(*size, 2)))
        writer.put_frame("depth", t, rng.random(size) + 300)
        writer.put_frame("traction", t, rng.normal(size=(*size, 3)))
    gesture = {"kind": "pull", "load": 0.1}
    writer.seal(
        scenario={"index": index, "family": "healthy", "gestures": [gesture]},
        scale_mm_per_px=0.1,
        young_kpa=1.0,
        poisson=0.4,
        timings={"render": {"cpu_s": time.process_time(), "wall_s": 0.0}},
    )


def _path() -> dict[str, str]:
    """Environment with which a process finds this module in any working directory."""
    known = filter(None, [str(report.CHECKOUT), os.environ.get("PYTHONPATH")])
    return {"PYTHONPATH": os.pathsep.join(known)}


def _cpu() -> float:
    mine, theirs = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return mine.ru_utime + mine.ru_stime + theirs.ru_utime + theirs.ru_stime


STUDY = Study(measure, "engine/speed.json", page)
