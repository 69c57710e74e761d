"""Versions of the installed packages that affect a sequence, and a description of the machine."""

from __future__ import annotations

import os
import platform
import re
from contextlib import suppress
from importlib import metadata
from pathlib import Path

_OPENCV = "opencv-contrib-python-headless"
COMPUTING = ("mitsuba", "drjit", "numpy", "scipy", _OPENCV, "onnxruntime", "numba", "llvmlite", "xatlas")


def versions() -> dict[str, str]:
    """`{package: version}` of the installed packages that affect a sequence, and of Python."""
    found = {"python": platform.python_version()}
    for name in ("sulcus", "zarr", "torch", *COMPUTING):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue  # optional, or run from a checkout that is not installed
    return found


def count_cores() -> int:
    """Cores that this process may use; on systems that don't say, all of them."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def machine() -> dict[str, str | int | float]:
    """Processor, cores, memory [GB], system and Python; nothing that identifies the machine."""
    model = None
    with suppress(OSError):  # of Linux alone
        model = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text())
    pages = getattr(os, "sysconf", lambda name: 0)  # not on Windows
    return {
        "processor": model.group(1) if model else platform.processor() or platform.machine(),
        "cores": count_cores(),
        "memory_gb": round(pages("SC_PHYS_PAGES") * pages("SC_PAGE_SIZE") / 1e9, 1),
        "system": platform.system(),
        "python": platform.python_version(),
    }
