"""A run's own account of itself, `.run/progress.json`, so that `synth status` can look on from elsewhere."""

from __future__ import annotations

import json
import time
from typing import Any

from synth.child import Attempt
from synth.folder import Folder, write_whole

_EVERY_S = 2.0


class Journal:
    """Told what happens in a run, as a watcher; writes it down every two seconds at most."""

    def __init__(self, folder: Folder, workers: int) -> None:
        self._path, self._workers = folder.state / "progress.json", workers
        self._started = self._written = time.monotonic()
        self._total = self._done = self._failed = self._before = 0
        self._in_flight: dict[int, list[Any]] = {}

    def begin(self, total: int, already: int, failed: int) -> None:
        self._total, self._before = total, already + failed
        self._write()

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        self._in_flight[index] = [stage, done, of]
        if time.monotonic() - self._written > _EVERY_S:
            self._write()

    def end(self, attempt: Attempt, again: bool) -> None:
        self._in_flight.pop(attempt.index, None)
        if not again:
            self._done += attempt.kind == "done"
            self._failed += attempt.kind not in ("done", "stopped")
        if time.monotonic() - self._written > _EVERY_S:
            self._write()

    def _write(self) -> None:
        self._written = time.monotonic()
        spent, finished = self._written - self._started, self._done + self._failed
        left = self._total - self._before - finished
        record = {
            "workers": self._workers,
            "seconds": round(spent, 1),
            "finished": finished,
            "left_s": round(spent / finished * left, 1) if finished else None,
            "in_flight": {str(key): value for key, value in sorted(self._in_flight.items())},
        }
        write_whole(self._path, json.dumps(record), durable=False)
