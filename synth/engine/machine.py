"""Resources of this machine for the workers of a run: GPUs, memory, threads, the renderer's LLVM."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from synth.errors import UserError
from synth.job.schema import Job
from synth.system import llvm


def gpus(chosen: str, wanted: bool) -> tuple[str, ...] | None:
    """Names of the GPUs that workers share, for CUDA_VISIBLE_DEVICES; None: it is not set.

    `chosen`: `auto`, `none` or names separated by commas; `wanted`: the job renders on a GPU, else `auto`
    sets nothing. UserError for a GPU that does not exist.
    """
    if chosen == "none":
        return ()
    if chosen == "auto":
        return (_visible_gpus() or None) if wanted else None
    named, here = tuple(word.strip() for word in chosen.split(",")), _visible_gpus()
    missing = [name for name in named if name not in here]
    if missing:
        raise UserError(f"--gpus {', '.join(missing)}: this machine has {', '.join(here) or 'none'}")
    return named


def _visible_gpus() -> tuple[str, ...]:
    """The GPUs in CUDA_VISIBLE_DEVICES, else all."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(name.strip() for name in visible.split(",") if name.strip())
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):  # no driver, or it does not respond
        return ()
    count = sum(line.startswith("GPU ") for line in listed.stdout.splitlines())
    return tuple(str(k) for k in range(count)) if listed.returncode == 0 else ()


def environment(job: Job, workers: int) -> dict[str, str]:
    """Environment of all workers of a machine: the number of threads of each, and the renderer's LLVM."""
    threads = max(1, len(os.sched_getaffinity(0)) // workers)
    library = llvm.find() if job.render.variant in ("auto", "llvm_ad_rgb") else None
    return {"SULCUS_THREADS": str(threads), "SULCUS_LLVM": library or ""}


def share_of_memory(workers: int) -> int | None:
    """Bytes of the available memory for each of `workers` processes; None if unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:  # a system without /proc
        return None
    fields = dict(line.split(":") for line in lines)
    return int(0.9 * int(fields["MemAvailable"].split()[0]) * 1024 / workers)
