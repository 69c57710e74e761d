"""Versions of the installed packages that affect a sequence, and a description of the machine."""

from __future__ import annotations

import platform
import re
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path

from synth.system import resources

_OPENCV = "opencv-contrib-python-headless"
COMPUTING = ("mitsuba", "drjit", "numpy", "scipy", _OPENCV, "onnxruntime", "numba", "llvmlite", "xatlas")


def versions() -> dict[str, str]:
    """`{package: version}` of the installed packages that affect a sequence, and of Python."""
    return dict(_versions())


@cache  # reading them takes 45 ms, and every sequence states them
def _versions() -> dict[str, str]:
    by_package = {"python": platform.python_version()}
    for name in ("sulcus", "zarr", "torch", *COMPUTING):
        try:
            by_package[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue  # optional, or run from a checkout that is not installed
    return by_package


def machine() -> dict[str, str | int | float]:
    """Processor, cores and memory [GB] of this process, system, Python; nothing that identifies it."""
    model = None
    with suppress(OSError):  # of Linux alone
        model = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text())
    return {
        "processor": model.group(1) if model else platform.processor() or platform.machine(),
        "cores": resources.cores(),
        "memory_gb": round((resources.memory() or 0) / 1e9, 1),
        "system": platform.system(),
        "python": platform.python_version(),
    }
