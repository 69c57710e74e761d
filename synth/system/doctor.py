"""What this machine offers to the program, and what to do about what it lacks."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import platform
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from synth.system import cache, llvm, packages

_LEAST_FREE_GB = 5.0
_LEAST_MEMORY_GB = 4.0


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    what: str
    found: str
    good: bool = True
    advice: str = ""
    """What to do, when it is not good."""


def findings(folder: Path) -> list[Finding]:
    """Everything that is looked at; `folder` is where datasets would go."""
    return list(_findings(folder))


def _findings(folder: Path) -> Iterator[Finding]:
    yield Finding("system", f"{platform.system()} {platform.machine()}, Python {platform.python_version()}")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    yield Finding("cores", str(cores))
    yield from _memory()
    yield _disk(folder)
    library = llvm.find()
    gpu = _cuda()
    yield Finding(
        "LLVM",
        library or "none that works",
        library is not None,
        "install LLVM 17 or newer (Debian: apt-get install libllvm19), or set DRJIT_LIBLLVM_PATH",
    )
    yield Finding("CUDA", f"{gpu}; render.variant=cuda_ad_rgb uses it" if gpu else "no GPU (not needed)")
    variant = "llvm_ad_rgb" if library else "scalar_rgb"
    yield Finding(
        "renderer", variant, variant != "scalar_rgb", "the slow variant works; LLVM halves the time"
    )
    yield from _lacking()
    yield _kernels()
    for name, version in packages.versions().items():
        yield Finding(name, version)
    for name in ("mitsuba", "cv2", "torch", "trimesh", "av"):
        if importlib.util.find_spec(name) is None:
            yield Finding(name, "missing", False, "pip install -c constraints.txt . in the project's folder")


def _memory() -> Iterator[Finding]:
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        size = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
        yield Finding(
            "memory", f"{size:.1f} GB", size >= _LEAST_MEMORY_GB, "use --workers 1 and a smaller render.size"
        )


def _lacking() -> Iterator[Finding]:
    """A system's library that the renderer is linked against, where the loader doesn't find it."""
    spec = importlib.util.find_spec("drjit")
    threads = Path(spec.origin or "").parent / "libnanothread.so" if spec else Path()
    if not threads.is_file():
        return
    try:
        ctypes.CDLL(str(threads))
    except OSError as error:
        advice = "install it (Debian: apt-get install libatomic1): nothing is rendered without"
        yield Finding("renderer's libraries", str(error), False, advice)


def _kernels() -> Finding:
    try:
        place = cache.folder("kernels")
    except OSError as error:
        return Finding("compiled kernels", f"not kept ({error})", False, "set SULCUS_CACHE to a folder")
    held = cache.size_bytes(place) / 1e6
    return Finding("compiled kernels", f"{held:.0f} MB of at most {cache.LIMIT_BYTES / 1e6:.0f} in {place}")


def _disk(folder: Path) -> Finding:
    there = folder.resolve()
    while not there.exists():
        there = there.parent
    free = shutil.disk_usage(there).free / 1e9
    writable = os.access(there, os.W_OK)
    found = f"{free:.1f} GB free at {there}" + ("" if writable else ", not writable")
    return Finding("disk", found, writable and free >= _LEAST_FREE_GB, "choose another folder with -o")


def _cuda() -> str | None:
    try:
        query = ["nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
        done = subprocess.run(query, capture_output=True, text=True, timeout=20, check=False)
    except (FileNotFoundError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None
