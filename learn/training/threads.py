"""What a training runs on: threads, and the devices that Fabric puts it on."""

from __future__ import annotations

import os
import warnings
from typing import TYPE_CHECKING, Any

import torch

from synth.errors import UserError

if TYPE_CHECKING:
    from lightning_fabric import Fabric


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


def make_fabric(**settings: Any) -> Fabric:
    """`Fabric(**settings)`, without its hint that `srun` is there: on a cluster's machines it always is."""
    from lightning_fabric import Fabric

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The `srun` command is available")
        return Fabric(**settings)
