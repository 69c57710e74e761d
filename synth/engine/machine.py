"""What this machine gives to the workers of a run: GPUs, memory, threads, the renderer's LLVM."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from synth.errors import UserError
from synth.job.schema import Job
from synth.system import llvm


def gpus(chosen: str, wanted: bool) -> tuple[str, ...] | None:
    """Names of the GPUs that workers share, as CUDA_VISIBLE_DEVICES takes them; None: nothing is set.

    Args:
        chosen: `auto`, `none` or names with commas between.
        wanted: whether the job renders on a GPU; else `auto` sets nothing.

    Raises:
        UserError: a GPU that is not there.
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
    """What a scheduler left visible, or all."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(name.strip() for name in visible.split(",") if name.strip())
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):  # no driver, or one that does not answer
        return ()
    count = sum(line.startswith("GPU ") for line in listed.stdout.splitlines())
    return tuple(str(k) for k in range(count)) if listed.returncode == 0 else ()


def environment(job: Job, workers: int) -> dict[str, str]:
    """What is found out once for all workers of a machine: threads for each, and the renderer's LLVM."""
    threads = max(1, len(os.sched_getaffinity(0)) // workers)
    library = llvm.find() if job.render.variant in ("auto", "llvm_ad_rgb") else None
    return {"SULCUS_THREADS": str(threads), "SULCUS_LLVM": library or ""}


def share_of_memory(workers: int) -> int | None:
    """Bytes that each of `workers` processes may take of what is available now; None if that is not known."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:  # a system without /proc: its own limits must do
        return None
    fields = dict(line.split(":") for line in lines)
    return int(0.9 * int(fields["MemAvailable"].split()[0]) * 1024 / workers)
