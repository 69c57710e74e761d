"""CPU threads and devices of a training."""

from __future__ import annotations

import os
import warnings
from typing import TYPE_CHECKING, Any

import torch

from synth.errors import UserError

if TYPE_CHECKING:
    from lightning_fabric import Fabric


def set_threads(wanted: int | None = None) -> int:
    """Sets and returns PyTorch's number of threads; default: half the cores, from 1 to 8.

    Two threads on two busy cores wait for each other (measured: thirty seconds instead of half a second).
    """
    if wanted is not None and wanted < 1:
        raise UserError(f"threads {wanted}: must be at least 1")
    cores = len(os.sched_getaffinity(0))
    count = wanted or min(max(cores // 2, 1), 8)
    torch.set_num_threads(count)
    return count


def make_fabric(**settings: Any) -> Fabric:
    """`Fabric(**settings)` without its hints; a GPU multiplies 32-bit numbers in TF32."""
    from lightning_fabric import Fabric

    if settings.get("accelerator") != "cpu" and torch.cuda.is_available():
        torch.set_float32_matmul_precision("high")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The `srun` command is available")
        return Fabric(**settings)
