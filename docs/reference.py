"""Writes the reference pages that say what the code says: `python docs/reference.py` (`make docs` runs it).

Job keys come from the schema, fields from the field table, commands from the command line's own help.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import typer

ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = ("synth", "learn", "bench")


@dataclass(frozen=True)
class Spoken:
    """One command as a person types it."""

    words: tuple[str, ...]
    """("bench", "pareto", "flow")."""
    command: Any
    """The click command behind it; `Any`, as newer typer releases carry their own copy of click."""

    @property
    def examples(self) -> list[str]:
        """The lines of its help that begin with `Example:`, without that word."""
        lines = (self.command.epilog or "").splitlines()
        return [line.partition("Example:")[2].strip() for line in lines if "Example:" in line]


def commands() -> Iterator[Spoken]:
    """Every command of the three programs that does something itself, and the groups before theirs."""
    for name in PROGRAMS:
        yield from _below(typer.main.get_command(import_module(f"{name}.cli").app), (name,))


def _below(command: Any, words: tuple[str, ...]) -> Iterator[Spoken]:
    yield Spoken(words, command)
    if hasattr(command, "list_commands"):
        context = command.make_context(words[-1], [], resilient_parsing=True)
        for name in command.list_commands(context):
            yield from _below(command.get_command(context, name), (*words, name))
