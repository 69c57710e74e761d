"""CPU threads, and the device of a training."""

from __future__ import annotations

from typing import TYPE_CHECKING

from synth.errors import UserError
from synth.system import resources

if TYPE_CHECKING:
    import torch


def choose_threads(count: int | None = None) -> int:
    """The number of threads of a network; default: half the cores, from 1 to 8.

    Two threads on two busy cores wait for each other (measured: thirty seconds instead of half a second).
    """
    if count is not None and count < 1:
        raise UserError(f"threads {count}: must be at least 1")
    return count or min(max(resources.cores() // 2, 1), 8)


def set_threads(count: int | None = None) -> None:
    """Sets PyTorch's number of threads, as of `choose_threads`."""
    import torch

    torch.set_num_threads(choose_threads(count))


def choose_device(accelerator: str) -> torch.device:
    """The device of `cpu`, `cuda` or `auto`: a GPU if there is one, which multiplies 32-bit numbers in TF32.

    UserError: another name, or no GPU.
    """
    import torch

    gpu = torch.cuda.is_available()
    if accelerator not in ("cpu", "cuda", "auto") or (accelerator == "cuda" and not gpu):
        reason = "no GPU was found" if accelerator == "cuda" else "must be cpu, cuda or auto"
        raise UserError(f"accelerator {accelerator}: {reason}")
    if accelerator == "cpu" or not gpu:
        return torch.device("cpu")
    torch.set_float32_matmul_precision("high")
    return torch.device("cuda")
