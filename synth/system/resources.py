"""Cores and memory that this process may use: the machine's, less what affinity and control groups withhold.

A container with `--cpus=2 --memory=4g` sees all of its host's cores and memory; only its control group (of
version 1 or 2) knows its share. `root` is `/`, or a folder with the same files below `proc` and `sys`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

_ROOT = Path("/")
_SHARE = 0.5  # of the free memory, which one array from a file may take: it is copied once


def cores(root: Path = _ROOT) -> int:
    """Cores to compute on, at least 1: as many as the scheduler grants, at most the quotas, rounded up."""
    quotas = [quota for group in _groups("cpu", root) if (quota := _quota(group)) is not None]
    affinity = getattr(os, "sched_getaffinity", None)  # Linux has it
    granted = (os.cpu_count() or 1) if affinity is None else len(affinity(0))
    return max(1, math.ceil(min([granted, *quotas])))


def memory(root: Path = _ROOT) -> int | None:
    """Bytes of memory: the machine's, at most the lowest limit; None on systems without /proc."""
    total = _meminfo("MemTotal", root)
    return None if total is None else min([total, *(limit for limit, _ in _memory_groups(root))])


def free_memory(root: Path = _ROOT) -> int | None:
    """Bytes that can still be used, cached files not counted as used; None on systems without /proc."""
    free = _meminfo("MemAvailable", root)
    remaining = (limit - used for limit, used in _memory_groups(root))
    return None if free is None else max(0, min([free, *remaining]))


def refuse_excess(needed: int) -> None:
    """Raises ValueError if an array of so many bytes takes more than half of the free memory."""
    free = free_memory()
    if free is not None and needed > _SHARE * free:
        raise ValueError(f"needs {needed / 1e9:.3g} GB of memory, {free / 1e9:.3g} GB are free")


def _meminfo(name: str, root: Path) -> int | None:
    fields = dict(line.split(":", 1) for line in _read(root / "proc/meminfo").splitlines() if ":" in line)
    words = fields.get(name, "").split()
    return int(words[0]) * 1024 if words else None


def _memory_groups(root: Path) -> Iterator[tuple[int, int]]:
    """Limit and use, in bytes, of each control group with a limit."""
    files = (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    )
    for group in _groups("memory", root):
        for limit_file, use_file, cached in files:
            limit = _read(group / limit_file)
            if limit.isdecimal():  # `max` if there is none; version 1 has a number beyond any memory
                stat = dict(line.split() for line in _read(group / "memory.stat").splitlines())
                yield int(limit), int(_read(group / use_file) or 0) - int(stat.get(cached, 0))


def _quota(group: Path) -> float | None:
    """Cores by the quota of a control group; None if it has none."""
    words = _read(group / "cpu.max").split()
    words = words or [_read(group / f"cpu.cfs_{name}_us") for name in ("quota", "period")]
    if all(word.isdecimal() for word in words) and int(words[1]):  # not `max`, -1, or a missing file
        return int(words[0]) / int(words[1])
    return None


def _groups(controller: str, root: Path) -> Iterator[Path]:
    """Folders of this process's control groups, from its own up to the highest that can be seen."""
    mounts = root / "sys/fs/cgroup"
    for line in _read(root / "proc/self/cgroup").splitlines():
        _, names, path = line.split(":", 2)
        if names and controller not in names.split(","):
            continue
        # A host mounts version 2 at the top, or, beside version 1, at `unified`.
        tops = (mounts / names, mounts / controller) if names else (mounts, mounts / "unified")
        for top in (top for top in tops if top.is_dir()):
            inside = Path(path).relative_to("/")
            yield from (top / part for part in (inside, *inside.parents))
            break


def _read(file: Path) -> str:
    """Text of a small file; empty if it can't be read, as where no such group is seen from a container."""
    try:
        return file.read_text().strip()
    except OSError:
        return ""
