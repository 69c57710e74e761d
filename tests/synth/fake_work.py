"""Stand-ins for the pipeline: sequences that cost nothing, and such that end badly."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from synth.errors import UserError
from synth.job import Job
from synth.store import Writer

Report = Callable[[str, int, int], None]


def sequence(job: Job, index: int, folder: Path, report: Report) -> None:
    """A sequence whose every field is random, from the job's seed and the index only."""
    rng = np.random.default_rng((job.seed, index))
    width, height = job.render.size
    writer = Writer(folder, index, frames=job.frames, size=(height, width), job=job)
    writer.put("time", np.arange(job.frames) / job.fps)
    writer.put("force", rng.normal(size=(job.frames, 3)))
    writer.put("tissue", rng.random((height, width)) > 0.2)
    writer.put("area", rng.random((height, width)))
    for t in range(job.frames):
        report("render", t, job.frames)
        for name in ("visible", "tool", "glare"):
            writer.put_frame(name, t, rng.random((height, width)) > 0.5)
        writer.put_frame("rgb", t, rng.integers(0, 256, (height, width, 3)).astype(np.uint8))
        writer.put_frame("flow", t, rng.normal(size=(height, width, 2)))
        writer.put_frame("depth", t, rng.random((height, width)) + 300)
        writer.put_frame("traction", t, rng.normal(size=(height, width, 3)))
    writer.seal(**attributes(index, rng))


def attributes(index: int, rng: np.random.Generator) -> dict[str, Any]:
    return {
        "scenario": {
            "index": index,
            "anatomy": index,
            "family": "healthy",
            "gesture": {"kind": "pull", "load": 0.1},
        },
        "scale_mm_per_px": 0.1,
        "young_kpa": float(rng.uniform(0.5, 3)),
        "poisson": 0.4,
        "timings": {"render": {"cpu_s": time.process_time(), "wall_s": 0.0}},
    }


def troubled(job: Job, index: int, folder: Path, report: Report) -> None:
    """1 aborts, 2 fills memory, 3 is NaN, 4 raises, 5 hangs, 6 refuses, 7 works at the second try."""
    if index == 1:
        report("render", 0, 1)
        os.abort()
    if index == 2:
        held = []
        while True:
            held.append(np.ones(1 << 22))
            report("fem", len(held), 1 << 20)
    if index == 3:
        writer = Writer(folder, index, frames=job.frames, size=(8, 8), job=job)
        writer.put("force", np.full((job.frames, 3), np.nan))
    if index == 4:
        raise ZeroDivisionError("by nought")
    if index == 5:
        time.sleep(600)
    if index == 6:
        raise UserError("the load is past the material's range")
    if index == 7:
        tried = folder / ".run" / "tried"
        if not tried.exists():
            tried.touch()
            os.kill(os.getpid(), 9)
    sequence(job, index, folder, report)


def refused(job: Job, index: int, folder: Path, report: Report) -> None:
    """No sequence of this job can be carried out."""
    raise UserError("no surface at the craniotomy")


def full(job: Job, index: int, folder: Path, report: Report) -> None:
    """The disk is full at the third sequence."""
    if index >= 2:
        raise OSError(28, "No space left on device")
    sequence(job, index, folder, report)


def slow(job: Job, index: int, folder: Path, report: Report) -> None:
    """A sequence that takes its time, so that it can be interrupted."""
    for t in range(5):
        report("fem", t, 5)
        time.sleep(0.05)
    sequence(job, index, folder, report)
