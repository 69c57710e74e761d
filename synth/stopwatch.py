"""CPU-seconds and peak memory by stage: with progress and patience, all in `synth` that reads a clock."""

from __future__ import annotations

import resource
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Adds up CPU time and wall time under the name of a stage."""

    def __init__(self, *, own_thread: bool = False) -> None:
        """Starts at nothing.

        Args:
            own_thread: CPU time of the thread that runs the stage, for stages that run side by side; else of
                all threads of this process.
        """
        self._clock = time.thread_time if own_thread else time.process_time
        self._cpu: dict[str, float] = defaultdict(float)
        self._wall: dict[str, float] = defaultdict(float)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times the block under `name`; blocks of one name add up."""
        cpu, wall = self._clock(), time.perf_counter()
        try:
            yield
        finally:
            self._cpu[name] += self._clock() - cpu
            self._wall[name] += time.perf_counter() - wall

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
