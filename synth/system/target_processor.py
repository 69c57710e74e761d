"""The processor that loops are compiled for, found without numba: its import takes longer than that."""

from __future__ import annotations

import os
from contextlib import suppress

from llvmlite import binding

COMMON = "x86-64-v3"
_FEATURES = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")  # of it, beyond those of v2


def has_common() -> bool:
    """Whether this processor runs what is compiled for `COMMON`."""
    with suppress(RuntimeError):  # LLVM doesn't know this processor
        features = binding.get_host_cpu_features()
        return all(features.get(name) for name in _FEATURES)
    return False


def target() -> str:
    """The processor that loops are compiled for.

    It is x86-64-v3 where that runs, so that such machines compute the same bits and can share a cache; as
    fast as the host's own name here. `NUMBA_CPU_NAME` overrides it.
    """
    override = os.environ.get("NUMBA_CPU_NAME")
    return override or (COMMON if has_common() else str(binding.get_host_cpu_name()))
