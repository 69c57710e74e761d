"""The state of a run: stored in a file for `synth status`, reported to watchers, and drawn as bars."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from rich.progress import TaskID, TextColumn, TimeElapsedColumn

from synth.dataset.dataset_folder import Folder, write_whole
from synth.engine.child import Attempt
from synth.system.terminal import ProgressBars, clock

_EVERY_S = 2.0
_LATEST = 32  # sequences that the rate is estimated from
_QUIET_S = 10.0  # least time between two lines without a terminal


@dataclass(frozen=True)
class RunProgress:
    """A run at one moment."""

    left_s: float | None = None  # to the end, at the latest sequences' rate; None until enough are finished
    in_flight: dict[str, list[Any]] = field(default_factory=dict)  # sequence -> stage, steps done, all steps


class Watcher:
    """Callbacks for the events of a run, called from the main thread only; this class ignores them."""

    def begin(self, total: int, already: int, failed: int) -> None:
        """A run begins."""

    def prepare(self, text: str) -> None:
        """Something is done first that takes time, as `text` says."""

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        """A sequence is at a stage."""

    def end(self, attempt: Attempt, again: bool) -> None:
        """An attempt at a sequence has ended."""

    def account(self, progress: RunProgress) -> None:
        """Progress of the run, at most every two seconds, before the event that caused it."""


class Journal(Watcher):
    """Writes the progress of a run to a file, and reports it."""

    def __init__(self, folder: Folder, workers: int, report: Callable[[RunProgress], None]) -> None:
        self._path, self._report = folder.progress_file, report
        self._cold, self._left, self._written = workers, 0, -_EVERY_S
        self._ends: deque[float] = deque(maxlen=_LATEST + 1)
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

    def estimate_left_s(self) -> float | None:
        """Seconds to the end, by the latest sequences; None until there are enough."""
        count = len(self._ends) - 1
        return (self._ends[-1] - self._ends[0]) / count * self._left if count > 0 else None

    def _write(self) -> None:
        now = time.monotonic()
        if self._left and now - self._written < _EVERY_S:
            return
        self._written = now
        progress = RunProgress(
            self.estimate_left_s(), {str(k): steps for k, steps in sorted(self._in_flight.items())}
        )
        write_whole(self._path, json.dumps(asdict(progress)), durable=False)
        self._report(progress)


class RunBars(ProgressBars, Watcher):
    """A bar for the dataset and one for every sequence in work; plain lines without a terminal."""

    def __init__(self) -> None:
        super().__init__(TimeElapsedColumn(), TextColumn("{task.fields[left]}", style="cyan"))
        self._bars: dict[int, TaskID] = {}
        self._dataset = self.add_task("sequences", total=None, left="")
        self._printed = time.monotonic()

    def begin(self, total: int, already: int, failed: int) -> None:
        self.reset(self._dataset, total=total, completed=already + failed)
        if already or failed:
            hint = f", {failed} failed (`--retry` computes them again)" if failed else ""
            self._print(f"{already} of {total} sequences are done already{hint}")

    def prepare(self, text: str) -> None:
        self._print(text)

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        if index not in self._bars:
            self._bars[index] = self.add_task("", left="")
        self.update(self._bars[index], description=f"  {index:06d} {stage}", completed=done, total=max(of, 1))

    def end(self, attempt: Attempt, again: bool) -> None:
        if attempt.index in self._bars:
            self.remove_task(self._bars.pop(attempt.index))
        if attempt.kind == "stopped":
            return
        if attempt.kind != "done":
            outcome = "is retried" if again else "failed"
            self._print(f"sequence {attempt.index:06d} {outcome}: {attempt.reason}")
        if again:
            return
        self.advance(self._dataset)
        dataset_task = next(task for task in self.tasks if task.id == self._dataset)
        quiet = time.monotonic() - self._printed < _QUIET_S and not dataset_task.finished
        if self.disable and not quiet:
            self._printed = time.monotonic()
            times = ", ".join(
                filter(None, (f"{clock(dataset_task.elapsed or 0.0)} spent", dataset_task.fields["left"]))
            )
            self._print(f"{dataset_task.completed:.0f} of {dataset_task.total:.0f} sequences, {times}")

    def account(self, progress: RunProgress) -> None:
        left = "" if progress.left_s is None else f"{clock(progress.left_s)} left"
        self.update(self._dataset, left=left)

    def _print(self, text: str) -> None:
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)
