"""Resources of this machine for the workers of a run: GPUs, memory, threads, the renderer's LLVM."""

from __future__ import annotations

import os
from pathlib import Path

from synth.errors import UserError
from synth.job.schema import Job
from synth.system import gpu, llvm


def gpus(chosen: str, wanted: bool) -> tuple[str, ...] | None:
    """Names of the GPUs that workers share, for CUDA_VISIBLE_DEVICES; None: it is not set.

    `chosen`: `auto`, `none` or names separated by commas; `wanted`: the job renders on a GPU, else `auto`
    sets nothing. UserError for a GPU that does not exist.
    """
    if chosen == "none":
        return ()
    if chosen == "auto":
        return (gpu.visible() or None) if wanted else None
    named, here = tuple(word.strip() for word in chosen.split(",")), gpu.visible()
    missing = [name for name in named if name not in here]
    if missing:
        raise UserError(f"--gpus {', '.join(missing)}: this machine has {', '.join(here) or 'none'}")
    return named


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
