"""CPU time and peak memory by stage."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

StageCallback = Callable[[str, int, int], None]  # called with a stage's name, steps done, steps in all


class Stopwatch:
    """Adds up CPU time (all threads of this process) and wall time under the name of a stage."""

    def __init__(self) -> None:
        self._spent_s: dict[str, tuple[float, float]] = {}  # CPU and wall time

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time of the block to that of stage `name`."""
        cpu, wall = time.process_time(), time.perf_counter()
        try:
            yield
        finally:
            self.add(name, time.process_time() - cpu, time.perf_counter() - wall)

    def add(self, name: str, cpu_s: float, wall_s: float) -> None:
        """Adds time that was spent on a stage [s], here or in another process."""
        cpu, wall = self._spent_s.get(name, (0.0, 0.0))
        self._spent_s[name] = cpu + cpu_s, wall + wall_s

    def cpu_s(self, name: str) -> float:
        """CPU time of one stage so far [s]; 0 for one that never ran."""
        return self._spent_s.get(name, (0.0, 0.0))[0]

    def report(self) -> dict[str, dict[str, float] | float]:
        """`{stage: {"cpu_s", "wall_s"}, ..., "peak_rss_mb"}`, seconds and MB (1e6 bytes)."""
        peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        times: dict[str, dict[str, float] | float] = {"peak_rss_mb": round(peak_kib * 1024 / 1e6, 1)}
        for name, (cpu, wall) in self._spent_s.items():
            times[name] = {"cpu_s": round(cpu, 3), "wall_s": round(wall, 3)}
        return times
