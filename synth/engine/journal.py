"""A run's own account of itself, told to the watcher and kept for `synth status`."""

from __future__ import annotations

import json
import time
from collections import deque
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from synth.dataset.folder import Folder, write_whole
from synth.engine.worker_process import Attempt

_EVERY_S = 2.0
_LATEST = 32  # sequences that say how fast it goes


@dataclass(frozen=True)
class Account:
    """A run at one moment."""

    left_s: float | None = None
    """To the end, at the latest sequences' rate; None until enough are finished."""
    in_flight: dict[str, list[Any]] | None = None
    """Stage, steps done and steps in all of the sequences being computed."""


class Watcher(Protocol):
    """Told what happens in a run, from the main thread only; by itself it does nothing."""

    def begin(self, total: int, already: int, failed: int) -> None:
        """A run begins."""
        return

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        """A sequence is at a stage."""
        return

    def end(self, attempt: Attempt, again: bool) -> None:
        """An attempt at a sequence has ended."""
        return

    def account(self, account: Account) -> None:
        """How the run stands."""
        return


class Journal:
    """Told what happens in a run; passes it on to a watcher, with an account every two seconds at most.

    The account comes first: what is said of the run is then said with what has just ended.
    """

    def __init__(self, folder: Folder, workers: int, watcher: Watcher) -> None:
        self._path, self._watcher = folder.state / "progress.json", watcher
        self._cold = workers
        self._ends: deque[float] = deque(maxlen=_LATEST + 1)
        self._left = 0
        self._written = -_EVERY_S
        self._in_flight: dict[int, list[Any]] = {}

    def begin(self, total: int, already: int, failed: int) -> None:
        self._left = total - already - failed
        self._tell()
        self._watcher.begin(total, already, failed)

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        self._in_flight[index] = [stage, done, of]
        self._tell()
        self._watcher.stage(index, stage, done, of)

    def end(self, attempt: Attempt, again: bool) -> None:
        self._in_flight.pop(attempt.index, None)
        if not again and attempt.kind != "stopped":
            self._left -= 1
            self.pace(time.monotonic())
        self._tell()
        self._watcher.end(attempt, again)

    def pace(self, at_s: float) -> None:
        """A sequence ended. The first of each worker only start the clock, as they also compile."""
        self._cold -= 1
        if self._cold <= 0:
            self._ends.append(at_s)

    def left_s(self) -> float | None:
        """Seconds to the end, by the latest sequences; None while there are first ones only."""
        count = len(self._ends) - 1
        return (self._ends[-1] - self._ends[0]) / count * self._left if count > 0 else None

    def _tell(self) -> None:
        now = time.monotonic()
        if self._left and now - self._written < _EVERY_S:
            return
        self._written = now
        made = Account(self.left_s(), {str(key): value for key, value in sorted(self._in_flight.items())})
        write_whole(self._path, json.dumps(asdict(made)), durable=False)
        self._watcher.account(made)
