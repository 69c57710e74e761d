"""CPU threads and the device of a training."""

from __future__ import annotations

import torch

from synth.errors import UserError
from synth.system.packages import count_cores


def set_threads(wanted: int | None = None) -> int:
    """Sets and returns PyTorch's number of threads; default: half the cores, from 1 to 8.

    Two threads on two busy cores wait for each other (measured: thirty seconds instead of half a second).
    """
    if wanted is not None and wanted < 1:
        raise UserError(f"threads {wanted}: must be at least 1")
    cores = count_cores()
    count = wanted or min(max(cores // 2, 1), 8)
    torch.set_num_threads(count)
    return count


def choose_device(accelerator: str) -> torch.device:
    """The device of `cpu`, `cuda` or `auto`: a GPU if there is one, which multiplies 32-bit numbers in TF32.

    UserError: another name, or no GPU.
    """
    gpu = torch.cuda.is_available()
    if accelerator not in ("cpu", "cuda", "auto") or (accelerator == "cuda" and not gpu):
        why = "no GPU was found" if accelerator == "cuda" else "must be cpu, cuda or auto"
        raise UserError(f"accelerator {accelerator}: {why}")
    if accelerator == "cpu" or not gpu:
        return torch.device("cpu")
    torch.set_float32_matmul_precision("high")
    return torch.device("cuda")
