"""The status of a dataset: sequences done, running and failed, and the time and disk still needed."""

from __future__ import annotations

import shutil
from collections import ChainMap, Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from synth.dataset import location, size_forecast
from synth.dataset.dataset_folder import Folder
from synth.dataset.size_forecast import Forecast
from synth.dataset.store import open_sequence
from synth.engine.journal import RunProgress
from synth.errors import UserError
from synth.system import checked_file, file_lock
from synth.system.config_file import validate_values
from synth.system.terminal import clock


@dataclass(frozen=True)
class Status:
    """A dataset at one moment."""

    total: int
    done: int
    failed: dict[str, int]  # reason -> number of sequences
    running: bool  # whether a run is writing to it now
    in_flight: dict[str, list[Any]]  # stage, steps done and steps in all of the sequences being computed
    left_s: float | None  # time to the end, at the rate of the current run
    ahead: Forecast
    disk_free: int  # bytes
    stages_cpu_s: dict[str, float]  # CPU time per sequence by stage, mean of up to ten finished ones


def read_status(root: Path) -> Status:
    """The status of the dataset in `root`. UserError if there is none."""
    folder = Folder(root)
    job, done, failures = folder.job(), folder.list_sealed(), folder.failures()
    todo = max(0, job.sequences - len(done) - len(set(failures) - set(done)))
    progress = _progress(folder)
    stages = _stages(root, size_forecast.pilot(done))
    return Status(
        total=job.sequences,
        done=len(done),
        failed=dict(Counter(failure["reason"] for failure in failures.values()).most_common()),
        running=progress is not None,
        in_flight=progress.in_flight if progress else {},
        left_s=progress.left_s if progress else None,
        ahead=size_forecast.forecast_rest(job, root, todo, done, sum(stages.values()) if stages else None),
        disk_free=shutil.disk_usage(root).free,
        stages_cpu_s=stages,
    )


def lines(status: Status) -> list[str]:
    """The status as lines of text."""
    count = sum(status.failed.values())
    rows = [f"{status.done} of {status.total} sequences done, {count} failed"]
    rows += [f"  {number} x {reason}" for reason, number in list(status.failed.items())[:10]]
    if count:
        rows.append("  `synth render --retry` computes the failed ones again")
    if status.running:
        left = "" if status.left_s is None else f", {clock(status.left_s)} left"
        rows.append(f"a run is in progress{left}")
        for key, (stage, step, of) in status.in_flight.items():
            rows.append(f"  {int(key):06d} {stage} {step} of {of}")
    elif status.ahead.sequences:
        rows.append("no run is in progress; `synth render` with the same job and folder continues")
    if status.stages_cpu_s:
        stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in status.stages_cpu_s.items())
        rows.append(f"CPU-seconds per sequence: {stages}")
    if status.ahead.sequences:
        ahead = status.ahead
        basis = f"from {ahead.pilot} finished" if ahead.pilot else "estimated"
        time = f", {clock(ahead.cpu_s)} of one core" if ahead.cpu_s is not None else ""
        needed, free = map(size_forecast.amount, (ahead.bytes, status.disk_free))
        rows.append(
            f"remaining: {ahead.sequences} sequences, {needed}{time} ({basis}); the disk has {free} free"
        )
    return rows


def _progress(folder: Folder) -> RunProgress | None:
    """Progress of the current run, or of all runs of parts together; None if there is none."""
    files = [*folder.running(), *([folder.progress_file] if file_lock.is_held(folder.lock_file) else [])]
    progress = RunProgress()
    for file in files:
        with suppress(UserError):  # it has just begun, or is of another version
            part = validate_values(RunProgress, checked_file.read_json(file), file.name)
            left = [seconds for seconds in (progress.left_s, part.left_s) if seconds is not None]
            progress = RunProgress(max(left, default=None), {**progress.in_flight, **part.in_flight})
    return progress if files else None


def _stages(root: Path, pilot: list[int]) -> dict[str, float]:
    timings = []
    for key in pilot:
        with suppress(UserError):  # damage is reported by `synth verify`
            timings.append(open_sequence(location.store(root, key)).stages_cpu_s)
    return {
        name: sum(stages.get(name, 0.0) for stages in timings) / len(timings) for name in ChainMap(*timings)
    }
