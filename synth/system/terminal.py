"""Output to a terminal: progress bars where they can be drawn, text wrapped at its width, durations."""

from __future__ import annotations

import shutil
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.util import find_spec

from rich import progress
from rich.console import Console

_LEAST_WIDTH = 16  # columns

ProgressCallback = Callable[[int, int], None]  # called with the number done and the number in all


class ProgressBars(progress.Progress):
    """Progress bars on stderr if they can be animated: in a terminal, or in a notebook with ipywidgets."""

    def __init__(self, *extra_columns: progress.ProgressColumn, transient: bool = False) -> None:
        console = Console(stderr=True)
        animated = console.is_terminal or (console.is_jupyter and find_spec("ipywidgets") is not None)
        text, counts = progress.TextColumn("{task.description}"), progress.MofNCompleteColumn()
        columns = (text, progress.BarColumn(), counts, *extra_columns)
        super().__init__(*columns, console=console, transient=transient, disable=not animated)


@contextmanager
def counting(what: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """A bar; yields a function of the number done and, if `total` is None, of the number in all."""
    with ProgressBars(progress.TimeRemainingColumn(), transient=True) as bars:
        task = bars.add_task(what, total=total)
        yield lambda done, of=None: bars.update(task, completed=done, total=of)


@contextmanager
def say_if_long(what: str, seconds: float = 2.0) -> Iterator[None]:
    """Prints a line on stderr if the work inside takes longer; each text once a process."""
    timer = threading.Timer(seconds, _say, (what,))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@lru_cache
def _say(what: str) -> None:
    print(what, file=sys.stderr, flush=True)


def hang(head: str, text: str) -> list[str]:
    """`text` after `head`, wrapped to the terminal's width with a hanging indent."""
    width = max(_LEAST_WIDTH, shutil.get_terminal_size().columns - len(head))
    words = textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False) or [""]
    return [f"{' ' * len(head) if k else head}{line}".rstrip() for k, line in enumerate(words)]


def clock(seconds: float) -> str:
    """9 s, 2:05 min, 3:20 h, 4.2 days."""
    rounded_s = round(seconds)
    if rounded_s < 60:
        return f"{rounded_s} s"
    if rounded_s < 3600:
        return f"{rounded_s // 60}:{rounded_s % 60:02d} min"
    if rounded_s < 86400:
        return f"{rounded_s // 3600}:{rounded_s % 3600 // 60:02d} h"
    return f"{seconds / 86400:.1f} days"
