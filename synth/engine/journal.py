"""A run's own account of itself: rates, time left, disk; told to the watcher and kept for `synth status`."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from synth.dataset import location, size_forecast
from synth.dataset.folder import Folder, write_whole
from synth.engine.eta import Pace
from synth.engine.worker_process import Attempt

_EVERY_S = 2.0


@dataclass(frozen=True)
class Account:
    """A run at one moment."""

    workers: int
    seconds: float
    """Since it began."""
    finished: int
    """Sequences that it finished or gave up."""
    left_s: float | None
    """To the end, at the latest sequences' rate; None until a sequence is finished."""
    cold: bool
    """Whether only first sequences are finished, which also compile: `left_s` is then too long."""
    step_s: dict[str, float]
    """Seconds that a worker takes for one step (a frame, where a stage has frames) of each stage."""
    frames_per_s: float | None
    """Of the whole run, all stages and workers together."""
    disk_left: float | None
    """Bytes that the sequences to come will take."""
    disk_free: int
    in_flight: dict[str, list[Any]]
    """Stage, steps done and steps in all of the sequences being computed."""


class Watcher(Protocol):
    """Told what happens in a run, from the main thread only."""

    def begin(self, total: int, already: int, failed: int) -> None: ...
    def stage(self, index: int, stage: str, done: int, of: int) -> None: ...
    def end(self, attempt: Attempt, again: bool) -> None: ...
    def account(self, account: Account) -> None: ...


class Journal:
    """Told what happens in a run; passes it on to a watcher, with an account every two seconds at most.

    The account comes first: what is said of the run is then said with what has just ended.
    """

    def __init__(self, folder: Folder, workers: int, frames: int, watcher: Watcher) -> None:
        self._folder, self._workers, self._frames, self._watcher = folder, workers, frames, watcher
        self._path = folder.state / "progress.json"
        self._started = self._written = time.monotonic()
        self._pace = Pace(workers)
        self._left = self._done = self._stored = 0
        self._in_flight: dict[int, list[Any]] = {}
        self._since: dict[int, float] = {}
        self._spent: dict[str, float] = {}
        self._steps: dict[str, int] = {}

    def begin(self, total: int, already: int, failed: int) -> None:
        self._left = total - already - failed
        self._tell()
        self._watcher.begin(total, already, failed)

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        now = time.monotonic()
        before = self._in_flight.get(index)
        if before is None or before[0] != stage:
            self._leave(index, now)
            self._since[index] = now
        self._in_flight[index] = [stage, done, of]
        if now - self._written > _EVERY_S:
            self._tell()
        self._watcher.stage(index, stage, done, of)

    def end(self, attempt: Attempt, again: bool) -> None:
        now = time.monotonic()
        if attempt.kind == "done":
            self._leave(attempt.index, now)
            self._stored += size_forecast.size(location.store(self._folder.root, attempt.index))
        self._in_flight.pop(attempt.index, None)
        self._since.pop(attempt.index, None)
        if not again and attempt.kind != "stopped":
            self._done += attempt.kind == "done"
            self._left -= 1
            self._pace.end(now - self._started)
        if self._pace.ended == 1 or not self._left or now - self._written > _EVERY_S:
            self._tell()
        self._watcher.end(attempt, again)

    def _leave(self, index: int, now: float) -> None:
        """Books the time of the stage that a sequence has come to the end of."""
        if index in self._since:
            stage, _, of = self._in_flight[index]
            self._spent[stage] = self._spent.get(stage, 0.0) + now - self._since[index]
            self._steps[stage] = self._steps.get(stage, 0) + max(of, 1)

    def _tell(self) -> None:
        self._written = time.monotonic()
        spent = self._written - self._started
        left_s = self._pace.left_s(self._left)
        made = Account(
            workers=self._workers,
            seconds=round(spent, 1),
            finished=self._pace.ended,
            left_s=None if left_s is None else round(left_s, 1),
            cold=self._pace.cold,
            step_s={name: round(self._spent[name] / self._steps[name], 3) for name in self._spent},
            frames_per_s=round(self._done * self._frames / spent, 3) if self._done else None,
            disk_left=self._stored / self._done * self._left if self._done else None,
            disk_free=shutil.disk_usage(self._folder.root).free,
            in_flight={str(key): value for key, value in sorted(self._in_flight.items())},
        )
        write_whole(self._path, json.dumps(asdict(made)), durable=False)
        self._watcher.account(made)
