"""How many threads PyTorch takes."""

from __future__ import annotations

import os

import torch

from synth.errors import UserError


def set_threads(wanted: int | None = None) -> int:
    """Half the cores, at most 8, at least one, unless told otherwise; returns what was set.

    Two threads on two busy cores wait for each other (measured: thirty seconds for what one thread did in
    half a second), so a small machine gets one.
    """
    if wanted is not None and wanted < 1:
        raise UserError(f"threads {wanted}: at least 1")
    cores = len(os.sched_getaffinity(0))
    count = wanted or min(max(cores // 2, 1), 8)
    torch.set_num_threads(count)
    return count
