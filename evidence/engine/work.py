"""Stand-ins for rendering, so that the engine is measured and not the renderer: cheap and of set length."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from evidence.measuring import CHECKOUT
from synth.dataset.store import Writer
from synth.job.schema import Job
from synth.system.stopwatch import Report


def environment(**more: object) -> dict[str, str]:
    """What a process needs to find these stand-ins, wherever the command was given, and `more`."""
    path = os.pathsep.join(filter(None, [str(CHECKOUT), os.environ.get("PYTHONPATH")]))
    return {"PYTHONPATH": path, **{name: str(value) for name, value in more.items()}}


def sequence(job: Job, index: int, folder: Path, report: Report) -> None:
    """Every field random, from the job's seed and the index only."""
    rng = np.random.default_rng((job.seed, index))
    width, height = job.render.size
    writer = Writer(folder, index, frames=job.frames, size=(height, width), job=job)
    writer.put("time", np.arange(job.frames) / job.fps)
    writer.put("force", rng.normal(size=(job.frames, 3)))
    writer.put("tissue", rng.random((height, width)) > 0.2)
    writer.put("area", rng.random((height, width)))
    for t in range(job.frames):
        report("render", t, job.frames)
        writer.put_frame("rgb", t, rng.integers(0, 256, (height, width, 3)).astype(np.uint8))
        for name in ("visible", "tool", "glare"):
            writer.put_frame(name, t, rng.random((height, width)) > 0.5)
        writer.put_frame("flow", t, rng.normal(size=(height, width, 2)))
        writer.put_frame("depth", t, rng.random((height, width)) + 300)
        writer.put_frame("traction", t, rng.normal(size=(height, width, 3)))
        time.sleep(float(os.environ.get("STAND_IN_FRAME_S", "0")))
    writer.seal(**attributes(index, rng))


def attributes(index: int, rng: np.random.Generator) -> dict[str, Any]:
    """What a stand-in's store says of itself."""
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
    """As `sequence`, but the fifth aborts its process and the tenth takes all the memory it gets."""
    if index == 4:
        os.abort()
    if index == 9:
        held = []
        while True:
            held.append(np.ones(1 << 22))
            report("fem", len(held), 1 << 30)
    busy(job, index, folder, report)


def busy(job: Job, index: int, folder: Path, report: Report) -> None:
    """As `sequence`, after a second or so of arithmetic: what a core can do no faster."""
    rng = np.random.default_rng(index)
    matrix = rng.normal(size=(200, 200))
    until = time.process_time() + float(os.environ.get("STAND_IN_CPU_S", "1"))
    while time.process_time() < until:
        np.linalg.svd(matrix)
    sequence(job, index, folder, report)
