"""Where progress can be drawn."""

from __future__ import annotations

from importlib.util import find_spec

from rich.console import Console


def draws_bars(console: Console) -> bool:
    """Whether bars can move there: in a terminal, or in a notebook that has ipywidgets, which rich needs."""
    return console.is_terminal or (console.is_jupyter and find_spec("ipywidgets") is not None)
