"""The state of a run: stored in a file for `synth status`, and reported to watchers."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from synth.dataset.folder import Folder, write_whole
from synth.engine.child import Attempt

FILE = "progress.json"
_EVERY_S = 2.0
_LATEST = 32  # sequences that the rate is estimated from


@dataclass(frozen=True)
class RunProgress:
    """A run at one moment."""

    left_s: float | None = None  # to the end, at the latest sequences' rate; None until enough are finished
    in_flight: dict[str, list[Any]] = field(default_factory=dict)  # sequence -> stage, steps done, all steps


class Watcher:
    """Callbacks for the events of a run, called from the main thread only; this class ignores them."""

    def begin(self, total: int, already: int, failed: int) -> None:
        """A run begins."""

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        """A sequence is at a stage."""

    def end(self, attempt: Attempt, again: bool) -> None:
        """An attempt at a sequence has ended."""

    def account(self, progress: RunProgress) -> None:
        """Progress of the run, at most every two seconds, before the event that caused it."""


class Journal(Watcher):
    """Writes the progress of a run to a file, and reports it."""

    def __init__(self, folder: Folder, workers: int, report: Callable[[RunProgress], None]) -> None:
        self._path, self._report = folder.state / FILE, report
        self._cold = workers
        self._ends: deque[float] = deque(maxlen=_LATEST + 1)
        self._left = 0
        self._written = -_EVERY_S
        self._in_flight: dict[int, list[Any]] = {}

    def begin(self, total: int, already: int, failed: int) -> None:
        self._left = total - already - failed
        self._write()

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        self._in_flight[index] = [stage, done, of]
        self._write()

    def end(self, attempt: Attempt, again: bool) -> None:
        self._in_flight.pop(attempt.index, None)
        if not again and attempt.kind != "stopped":
            self._left -= 1
            self.pace(time.monotonic())
        self._write()

    def pace(self, at_s: float) -> None:
        """Records the end of a sequence, without the first of each worker, which includes compilation."""
        self._cold -= 1
        if self._cold <= 0:
            self._ends.append(at_s)

    def left_s(self) -> float | None:
        """Seconds to the end, by the latest sequences; None until there are enough."""
        count = len(self._ends) - 1
        return (self._ends[-1] - self._ends[0]) / count * self._left if count > 0 else None

    def _write(self) -> None:
        now = time.monotonic()
        if self._left and now - self._written < _EVERY_S:
            return
        self._written = now
        progress = RunProgress(self.left_s(), {str(k): at for k, at in sorted(self._in_flight.items())})
        write_whole(self._path, json.dumps(asdict(progress)), durable=False)
        self._report(progress)
