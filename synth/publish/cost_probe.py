"""What a job will cost, from some of its sequences carried out with fewer frames than they are to have."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from synth.dataset.store import open_sequence
from synth.job.schema import Job
from synth.sequence.pipeline import render_sequence

PARTS = 4
"""Sequences that are carried out: one for what is compiled once, and what is measured."""
_SHORT, _LONG = 3, 9  # frames: the difference is what a further frame takes


def measure_cost(job: Job, report: Callable[[], None] = lambda: None) -> dict[str, float]:
    """Processor time [s] of the whole job by stage, without what each worker takes to start.

    A sequence's gesture is the same however many frames it is cut into, so a frame of a shorter one is as
    dear, but for the larger step to it. `report` is called `PARTS` times at most, after each part. Raises
    UserError if the job cannot be carried out.
    """
    chosen = np.unique(np.linspace(0, job.sequences - 1, PARTS - 1).round().astype(int))
    found = []
    with tempfile.TemporaryDirectory() as folder:
        _stages(job, int(chosen[0]), 2, Path(folder))  # what is compiled once
        report()
        for index in chosen:
            found.append(_cost(job, int(index), Path(folder)))
            report()
    return {name: job.sequences * float(np.mean([one[name] for one in found])) for name in found[0]}


def _cost(job: Job, index: int, folder: Path) -> dict[str, float]:
    """Of one sequence."""
    if job.frames <= _SHORT + _LONG:
        return _stages(job, index, job.frames, folder)
    short, long = (_stages(job, index, frames, folder) for frames in (_SHORT, _LONG))
    more = (job.frames - _LONG) / (_LONG - _SHORT)
    return {name: long[name] + max(more * (long[name] - short[name]), 0.0) for name in long}


def _stages(job: Job, index: int, frames: int, folder: Path) -> dict[str, float]:
    path = render_sequence(job.model_copy(update={"frames": frames}), index, folder, _quiet)
    timings = open_sequence(path).attrs["timings"]
    shutil.rmtree(path)
    return {name: stage["cpu_s"] for name, stage in timings.items() if isinstance(stage, dict)}


def _quiet(stage: str, done: int, of: int) -> None:
    """Progress that nobody looks at."""
