"""Progress of a run on the terminal: what is being done, how far it is, how long it will take."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from types import TracebackType

from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TaskID, TextColumn
from rich.text import Text

from synth.dataset import size_forecast
from synth.engine.journal import Account
from synth.engine.worker_process import Attempt

# Without a terminal a line is printed at most so often.
_QUIET_S = 10.0


class _Eta(ProgressColumn):
    """Time spent, and for the whole run the time left."""

    def render(self, task: Task) -> Text:
        spent = clock(task.elapsed or 0.0)
        left = task.fields.get("left")
        return Text(f"{spent}, {left}" if left else spent, style="cyan")


class _Progress(Progress):
    """Bars with a line under them."""

    below = ""

    def get_renderables(self) -> Iterable[RenderableType]:
        yield from super().get_renderables()
        if self.below:
            yield Text(self.below, style="dim")


class Bars:
    """A bar for the dataset and one for every sequence in work; plain lines where there is no terminal."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._live = console.is_terminal
        self._bars = _Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Eta(), console=console
        )
        self._tasks: dict[int, TaskID] = {}
        self._whole = self._bars.add_task("sequences", total=None, start=True)
        self._started = self._said = time.monotonic()
        self._total = self._already = self._finished = 0
        self._rates = self._left = ""

    def __enter__(self) -> Bars:
        if self._live:
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._bars.stop()

    def begin(self, total: int, already: int, failed: int) -> None:
        self._total, self._already = total, already + failed
        self._bars.update(self._whole, total=total, completed=self._already)
        if already or failed:
            self._say(f"{already} of {total} sequences are there already" + _failed(failed))

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        if index not in self._tasks:
            self._tasks[index] = self._bars.add_task("", total=of)
        self._bars.update(
            self._tasks[index], description=f"  {index:06d} {stage}", completed=done, total=max(of, 1)
        )

    def end(self, attempt: Attempt, again: bool) -> None:
        task = self._tasks.pop(attempt.index, None)
        if task is not None:
            self._bars.remove_task(task)
        if attempt.kind == "stopped":
            return
        if attempt.kind != "done":
            what = "is tried again" if again else "failed"
            self._say(f"sequence {attempt.index:06d} {what}: {attempt.reason}")
        if again:
            return
        self._finished += 1
        spent = time.monotonic() - self._started
        done = self._already + self._finished
        self._bars.update(self._whole, completed=done)
        quiet = time.monotonic() - self._said < _QUIET_S and done < self._total
        if not self._live and not quiet:
            self._said = time.monotonic()
            said = ", ".join(filter(None, (f"{clock(spent)} spent", self._left)))
            rest = f"; {self._rates}" if self._rates else ""
            self._say(f"{done} of {self._total} sequences, {said}{rest}")

    def account(self, account: Account) -> None:
        self._rates, self._left = rates(account), remaining(account)
        self._bars.below = self._rates
        self._bars.update(self._whole, left=self._left)

    def _say(self, text: str) -> None:
        if self._live:
            self._bars.console.print(text, highlight=False, markup=False)
        else:
            print(text, file=sys.stderr, flush=True)


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


def _failed(count: int) -> str:
    return f", {count} failed (`synth retry` takes them up again)" if count else ""
