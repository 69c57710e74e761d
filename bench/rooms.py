"""Where each room hangs its measuring commands: `bench pareto X`, `bench stability X` and so on.

A room adds one file, `bench/X_pareto.py`, with one plain function whose arguments are typer's, and one
line to `COMMANDS`. The module is imported only when its command (or its group's help) is asked for, so that
`bench --help` doesn't load Mitsuba and torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperGroup


@dataclass(frozen=True)
class Command:
    """One room's measuring command."""

    group: str
    """`pareto` (speed against accuracy), `stability` (where it breaks) or `experiment` (a question)."""
    name: str
    """The word after the group."""
    module: str
    """Module that holds it."""
    function: str
    """Function in that module; its docstring's first line is the help."""


COMMANDS: tuple[Command, ...] = (
    Command("experiment", "flow", "bench.flow_experiment", "experiment"),
    Command("stability", "flow", "bench.flow_stability", "stability"),
    Command("pareto", "flow", "bench.flow_pareto", "pareto"),
    Command("experiment", "realism", "bench.render_realism", "realism_figures"),
    Command("experiment", "render", "bench.render_cost", "experiment"),
    Command("stability", "render", "bench.render_stability", "stability"),
    Command("pareto", "render", "bench.render_pareto", "pareto"),
    Command("experiment", "camera-noise", "bench.render_noise", "camera_noise"),
    Command("experiment", "cycles", "bench.render_cycles", "cycles"),
    Command("experiment", "throughput", "bench.render_gpu", "throughput"),
    Command("experiment", "gpu", "bench.gpu", "gpu"),
    Command("experiment", "stages", "bench.stages", "stages"),
    Command("experiment", "leakage", "bench.leakage", "leakage"),
    Command("experiment", "inverse", "bench.inverse_experiment", "experiment"),
    Command("experiment", "learn", "bench.learn_experiment", "experiment"),
    Command("stability", "learn", "bench.learn_stability", "stability"),
    Command("experiment", "loading", "bench.learn_loading", "loading"),
    Command("experiment", "full-size", "bench.learn_full", "full_size"),
    Command("pareto", "learn", "bench.learn_pareto", "pareto"),
    Command("pareto", "fem", "bench.fem_pareto", "pareto"),
    Command("stability", "fem", "bench.fem_stability", "stability"),
    Command("experiment", "surface", "bench.fem_surface", "surface"),
    Command("stability", "damage", "bench.engine_damage", "damage"),
    Command("experiment", "scale", "bench.engine_scale", "scale"),
    Command("stability", "dask", "bench.engine_dask", "dask"),
    Command("stability", "trouble", "bench.engine_trouble", "trouble"),
    Command("pareto", "engine", "bench.engine_speed", "speed"),
    Command("pareto", "reading", "bench.engine_reading", "reading"),
    Command("experiment", "cost", "bench.engine_cost", "cost"),
    Command("stability", "faults", "bench.engine_faults", "faults"),
    Command("stability", "kills", "bench.engine_kills", "kills"),
)


class Rooms(TyperGroup):
    """A group whose commands are those of `COMMANDS` with the group's name.

    Typed `Any` where click's classes would stand: newer typer releases carry their own copy of click.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        return [entry.name for entry in COMMANDS if entry.group == self.name]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        for entry in COMMANDS:
            if entry.group == self.name and entry.name == cmd_name:
                return load(entry)
        return None


def load(entry: Command) -> Any:
    """The command behind an entry, its module imported.

    Raises:
        ImportError, AttributeError: the entry names what isn't there (a test loads every entry).
    """
    single = typer.Typer(add_completion=False)
    single.command(entry.name)(getattr(import_module(entry.module), entry.function))
    return typer.main.get_command(single)
