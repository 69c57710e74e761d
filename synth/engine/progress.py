"""Progress of a run on the terminal: what is being done, how far it is, how long it will take."""

from __future__ import annotations

import time
from collections.abc import Iterable

from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from synth.dataset import size_forecast
from synth.engine.journal import Account
from synth.engine.worker_process import Attempt
from synth.system.terminal import draws_bars

# Without a terminal a line is printed at most so often.
_QUIET_S = 10.0


class Bars(Progress):
    """A bar for the dataset and one for every sequence in work; plain lines where nothing can be drawn.

    What is left is the run's own estimate: rich knows nothing of workers whose first sequences also compile.
    """

    def __init__(self) -> None:
        self._rates = self._left = ""  # first: the bars are drawn as soon as they are made
        console = Console(stderr=True)
        columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()]
        left = TextColumn("{task.fields[left]}", style="cyan")
        super().__init__(*columns, left, console=console, disable=not draws_bars(console))
        self._bars: dict[int, TaskID] = {}
        self._dataset = self.add_task("sequences", total=None, left="")
        self._said = time.monotonic()

    def get_renderables(self) -> Iterable[RenderableType]:
        yield from super().get_renderables()
        if self._rates:
            yield Text(self._rates, style="dim")

    def begin(self, total: int, already: int, failed: int) -> None:
        self.reset(self._dataset, total=total, completed=already + failed)
        if already or failed:
            hint = f", {failed} failed (`synth retry` takes them up again)" if failed else ""
            self._say(f"{already} of {total} sequences are there already{hint}")

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
            what = "is tried again" if again else "failed"
            self._say(f"sequence {attempt.index:06d} {what}: {attempt.reason}")
        if again:
            return
        self.advance(self._dataset)
        whole = next(task for task in self.tasks if task.id == self._dataset)
        quiet = time.monotonic() - self._said < _QUIET_S and not whole.finished
        if self.disable and not quiet:
            self._said = time.monotonic()
            said = ", ".join(filter(None, (f"{clock(whole.elapsed or 0.0)} spent", self._left)))
            rest = f"; {self._rates}" if self._rates else ""
            self._say(f"{whole.completed:.0f} of {whole.total:.0f} sequences, {said}{rest}")

    def account(self, account: Account) -> None:
        self._rates, self._left = rates(account), remaining(account)
        self.update(self._dataset, left=self._left)

    def _say(self, text: str) -> None:
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)


def remaining(account: Account) -> str:
    """How long a run will take still: "2:05 min left", "at most 9 s left" while all is cold, or nothing."""
    if account.left_s is None:
        return ""
    return f"{'at most ' if account.cold and account.left_s else ''}{clock(account.left_s)} left"


def rates(account: Account) -> str:
    """How fast a run goes, what it will take: "render 0.62 s a step; 1.2 frames/s in all; 3 GB to come"."""
    parts = []
    if account.step_s:
        each = ", ".join(f"{name} {seconds:.2g} s" for name, seconds in account.step_s.items())
        parts.append(f"{each} a step")
    if account.frames_per_s is not None:
        parts.append(f"{account.frames_per_s:.2g} frames/s in all")
    if account.disk_left is not None and account.disk_left > 0:
        parts.append(
            f"{size_forecast.amount(account.disk_left)} to come, "
            f"{size_forecast.amount(account.disk_free)} free"
        )
    return "; ".join(parts)


def clock(seconds: float) -> str:
    """9 s, 2:05 min, 3:20 h, 4.2 days."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    if whole < 86400:
        return f"{whole // 3600}:{whole % 3600 // 60:02d} h"
    return f"{seconds / 86400:.1f} days"
