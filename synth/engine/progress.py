"""Progress of a run on the terminal: stages, sequences done, time left."""

from __future__ import annotations

import time

from rich.progress import TaskID, TextColumn, TimeElapsedColumn

from synth.engine.child import Attempt
from synth.engine.journal import RunProgress, Watcher
from synth.engine.status import clock
from synth.system.terminal import ProgressBars

_QUIET_S = 10.0  # least time between two lines without a terminal


class RunBars(ProgressBars, Watcher):
    """A bar for the dataset and one for every sequence in work; plain lines without a terminal.

    The time left is the run's estimate: that of rich would include the compilation in first sequences.
    """

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
            what = "is retried" if again else "failed"
            self._print(f"sequence {attempt.index:06d} {what}: {attempt.reason}")
        if again:
            return
        self.advance(self._dataset)
        whole = next(task for task in self.tasks if task.id == self._dataset)
        quiet = time.monotonic() - self._printed < _QUIET_S and not whole.finished
        if self.disable and not quiet:
            self._printed = time.monotonic()
            spent = ", ".join(filter(None, (f"{clock(whole.elapsed or 0.0)} spent", whole.fields["left"])))
            self._print(f"{whole.completed:.0f} of {whole.total:.0f} sequences, {spent}")

    def account(self, progress: RunProgress) -> None:
        left = "" if progress.left_s is None else f"{clock(progress.left_s)} left"
        self.update(self._dataset, left=left)

    def _print(self, text: str) -> None:
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)
