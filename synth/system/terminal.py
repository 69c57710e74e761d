"""Progress bars, where they can be drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

ProgressCallback = Callable[[int, int], None]
"""Told how many are done, and how many there are."""


class ProgressBars(Progress):
    """RunBars on stderr, where they can move: in a terminal, or in a notebook that has ipywidgets."""

    def __init__(self, *further: ProgressColumn, transient: bool = False) -> None:
        console = Console(stderr=True)
        drawn = console.is_terminal or (console.is_jupyter and find_spec("ipywidgets") is not None)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *further)
        super().__init__(*columns, console=console, transient=transient, disable=not drawn)


@contextmanager
def counting(what: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """A bar; gives a function of how many are done and, where `total` says nothing, of how many."""
    with ProgressBars(TimeRemainingColumn(), transient=True) as bars:
        task = bars.add_task(what, total=total)
        yield lambda done, of=None: bars.update(task, completed=done, total=of)
