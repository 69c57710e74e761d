"""CPU time and peak memory by stage."""

from __future__ import annotations

import resource
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

StageCallback = Callable[[str, int, int], None]  # called with a stage's name, steps done, steps in all


class Stopwatch:
    """Adds up CPU time (all threads of this process) and wall time under the name of a stage."""

    def __init__(self) -> None:
        self._cpu: dict[str, float] = defaultdict(float)
        self._wall: dict[str, float] = defaultdict(float)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time of the block to that of stage `name`."""
        cpu, wall = time.process_time(), time.perf_counter()
        try:
            yield
        finally:
            self._cpu[name] += time.process_time() - cpu
            self._wall[name] += time.perf_counter() - wall

    def add(self, name: str, cpu_s: float, wall_s: float) -> None:
        """Adds the time that another process spent on a stage [s]."""
        self._cpu[name] += cpu_s
        self._wall[name] += wall_s

    def cpu_s(self, name: str) -> float:
        """CPU time of one stage so far [s]; 0 for one that never ran."""
        return self._cpu.get(name, 0.0)

    def report(self) -> dict[str, dict[str, float] | float]:
        """`{stage: {"cpu_s", "wall_s"}, ..., "peak_rss_mb"}`, seconds and MB (1e6 bytes)."""
        peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        stages: dict[str, dict[str, float] | float] = {
            name: {"cpu_s": round(self._cpu[name], 3), "wall_s": round(self._wall[name], 3)}
            for name in self._cpu
        }
        stages["peak_rss_mb"] = round(peak_kib * 1024 / 1e6, 1)
        return stages
