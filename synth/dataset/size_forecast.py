"""Forecasts of disk, time and memory of a run, from finished sequences or from the field table."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synth.dataset import location
from synth.errors import UserError
from synth.fields import FIELDS, Field
from synth.job.schema import Job
from synth.system.checked_file import folder_bytes

_MARGIN = 1.25  # safety factor of estimates from the field table, so that a started run can finish
# Memory of the program with its libraries, per pixel, per vertex and frame, per pixel and frame.
_PROGRAM_BYTES, _STAGE_BYTES = 600e6, 2000
_MOTION_BYTES, _VIDEO_BYTES, _FLOW_BYTES = 60, 10, 14
_RESERVE_BYTES = 200e6  # disk space to leave free for index, card and system files


@dataclass(frozen=True)
class Forecast:
    """Disk and processor time of the remaining sequences."""

    sequences: int
    bytes: float
    cpu_s: float | None  # None until a sequence is finished
    pilot: int  # finished sequences that the forecast is based on; 0: the field table


def forecast_rest(
    job: Job, root: Path, todo: int, done: Sequence[int], cpu_s: float | None = None
) -> Forecast:
    """Forecast of `todo` more sequences, from the finished ones `done`; `cpu_s`: of one sequence [s]."""
    pilots = pilot(done)
    sequence_bytes = (
        np.mean([folder_bytes(location.store(root, key)) for key in pilots]) if pilots else estimate(job)
    )
    return Forecast(todo, float(sequence_bytes) * todo, None if cpu_s is None else cpu_s * todo, len(pilots))


def pilot(done: Sequence[int]) -> list[int]:
    """Up to ten of the finished sequences, spread over the dataset, to estimate the others from."""
    return [done[int(k)] for k in np.unique(np.linspace(0, len(done) - 1, 10).astype(int))] if done else []


def field_bytes(field: Field, frames: int, size: tuple[int, int], half: bool = False) -> tuple[float, float]:
    """Bytes of a field of `size` (height, width) in memory and on disk; `half`: `store.flow` is float16."""
    raw = float(np.prod(field.shape(frames, size))) * np.dtype(field.dtype).itemsize
    return raw, field.packed * (raw / 2 if half and field.half else raw)


def estimate(job: Job) -> float:
    """Bytes of one sequence of `job` on disk, from the field table."""
    width, height = job.render.size
    layout = job.frames, (height, width), job.store.flow == "float16"
    return _MARGIN * sum(field_bytes(FIELDS[name], *layout)[1] for name in job.stored_fields)


def estimate_memory(job: Job) -> float:
    """Bytes of memory that a worker needs for one sequence of `job`, whose motion and video are in memory.

    At most 1.5 times the measured peaks of 10 to 300 frames, 2,500 to 12,000 vertices, 64 to 320 columns.
    """
    width, height = job.render.size
    pixels = width * height * (2 if job.render.stereo_mm else 1)
    video = _VIDEO_BYTES + (_FLOW_BYTES if job.flow.backend != "ideal" else 0)
    frame_bytes = _MOTION_BYTES * job.anatomy.vertices + video * pixels
    return _MARGIN * (_PROGRAM_BYTES + _STAGE_BYTES * pixels + frame_bytes * job.frames)


def refuse_if_too_long(job: Job, worker_bytes: int, workers: int) -> None:
    """Raises UserError if a sequence needs more memory than a worker has."""
    if (needed := estimate_memory(job)) > worker_bytes:
        fewer = ", or --workers 1" if workers > 1 else ""
        raise UserError(
            f"a sequence of {job.frames} frames needs about {amount(needed)} of memory but each of {workers} "
            f"workers has {amount(worker_bytes)}: use fewer frames (frames=), a smaller render.size{fewer}"
        )


def refuse_if_too_large(forecast: Forecast, root: Path) -> None:
    """Raises UserError if the disk has not enough space for the remaining sequences."""
    free = shutil.disk_usage(root).free
    if forecast.bytes + _RESERVE_BYTES > free:
        basis = f"from {forecast.pilot} finished sequences" if forecast.pilot else "estimated"
        raise UserError(
            f"{root}: {forecast.sequences} sequences need {amount(forecast.bytes)} ({basis}), "
            f"the disk has {amount(free)} free"
        )


def amount(size_bytes: float) -> str:
    """1.2 kB, 34 MB, 5.6 GB, 7.8 TB."""
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if size_bytes >= scale:
            return f"{size_bytes / scale:.3g} {unit}"
    return f"{size_bytes / 1e3:.3g} kB"
