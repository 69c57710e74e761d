"""The memory that is free, and the refusal of data that would need more."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

_GROUPS = Path("/sys/fs/cgroup")
_SHARE = 0.5  # of the free memory, which one array from a file may take: it is copied once


def free_bytes() -> int | None:
    """Bytes that are free for this process: the machine's, or what its control groups (v2) leave of them.

    None on systems without /proc.
    """
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        fields = dict(line.split(":") for line in lines)
        free = int(fields["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return None
    with suppress(OSError, ValueError, IndexError):
        name = Path("/proc/self/cgroup").read_text().partition("0::")[2].splitlines()[0].lstrip("/")
        group = _GROUPS / name
        while group.is_relative_to(_GROUPS):
            free = min(free, _left(group, free))
            group = group.parent
    return max(free, 0)


def _left(group: Path, otherwise: int) -> int:
    """Bytes that a control group leaves; `otherwise` where it has no limit."""
    with suppress(OSError, ValueError):
        limit = int((group / "memory.max").read_text())
        stated = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        used = int((group / "memory.current").read_text()) - int(stated.get("inactive_file", 0))
        return limit - used
    return otherwise


def refuse_excess(needed: int) -> None:
    """Raises ValueError if an array of so many bytes takes more than half of the free memory."""
    free = free_bytes()
    if free is not None and needed > _SHARE * free:
        raise ValueError(f"needs {needed / 1e9:.3g} GB of memory, {free / 1e9:.3g} GB are free")
