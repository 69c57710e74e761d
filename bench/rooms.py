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
    example: str
    """What follows the names in the example of its help."""


COMMANDS: tuple[Command, ...] = (
    Command("experiment", "flow", "bench.flow_experiment", "experiment", "--out runs/flow --only warped"),
    Command("stability", "flow", "bench.flow_stability", "stability", "--out runs/flow --methods tvl1,dis"),
    Command("pareto", "flow", "bench.flow_pareto", "pareto", "--out runs/flow --count 2"),
    Command("experiment", "realism", "bench.render_realism", "realism_figures", "cortex.jpg"),
    Command("experiment", "render", "bench.render_cost", "experiment", "cost frames"),
    Command("stability", "render", "bench.render_stability", "stability", "--out runs/render"),
    Command("pareto", "render", "bench.render_pareto", "pareto", "--spp 2 --spp 8 --out runs/render"),
    Command("experiment", "camera-noise", "bench.render_noise", "camera_noise", "flats darks"),
    Command("experiment", "cycles", "bench.render_cycles", "cycles", "--python bpy/bin/python"),
    Command("experiment", "throughput", "bench.render_gpu", "throughput", "--spp 4 --out runs/gpu"),
    Command("experiment", "gpu", "bench.gpu", "gpu", "--out runs/gpu"),
    Command("experiment", "stages", "bench.stages", "stages", "out --out runs/stages"),
    Command("experiment", "leakage", "bench.leakage", "leakage", "out --out runs/leakage"),
    Command("experiment", "scoring", "bench.score_cost", "cost", "model --train out"),
    Command("experiment", "inverse", "bench.inverse_experiment", "experiment", "--count 10"),
    Command("experiment", "learn", "bench.learn_experiment", "experiment", "--cache cache --out runs/learn"),
    Command("stability", "learn", "bench.learn_stability", "stability", "--cache cache --seeds 2"),
    Command("experiment", "loading", "bench.learn_loading", "loading", "--steps 3 --out runs/loading"),
    Command("experiment", "full-size", "bench.learn_full", "full_size", "--cache cache --out full"),
    Command("pareto", "learn", "bench.learn_pareto", "pareto", "--out runs/learn --repeats 10"),
    Command("experiment", "tune", "bench.tune_experiment", "experiment", "--only easy --fresh 3"),
    Command("pareto", "end-to-end", "bench.end_to_end", "pareto", "--fit 8 --test 6 --out runs/end-to-end"),
    Command("pareto", "all", "bench.all_results", "pareto", "--out runs/all"),
    Command("stability", "all", "bench.all_results", "stability", "--out runs/all"),
    Command("pareto", "fem", "bench.fem_pareto", "pareto", "--load 0.3 --out runs/fem"),
    Command("stability", "fem", "bench.fem_stability", "stability", "--scenes 100 --out runs/fem"),
    Command("experiment", "surface", "bench.fem_surface", "surface", "brain.obj --direction=-0.4,0.8,0.45"),
    Command("stability", "damage", "bench.engine_damage", "damage", "out --count 50 --out runs/damage"),
    Command("experiment", "scale", "bench.engine_scale", "scale", "--sequences 10000 --out runs/scale"),
    Command("stability", "dask", "bench.engine_dask", "dask", "--workers 2 --out runs/dask"),
    Command("stability", "trouble", "bench.engine_trouble", "trouble", "--sequences 6 --out runs/trouble"),
    Command("pareto", "engine", "bench.engine_speed", "speed", "--rendered 4 --out runs/speed"),
    Command("pareto", "reading", "bench.engine_reading", "reading", "out --count 50 --out runs/reading"),
    Command("experiment", "cost", "bench.engine_cost", "cost", "out --frames 1000000 --page docs/scaling.md"),
    Command("stability", "faults", "bench.engine_faults", "faults", "--full tiny --read-only ro"),
    Command("stability", "kills", "bench.engine_kills", "kills", "--count 20 --out runs/kills"),
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
    single.command(entry.name, epilog=f"Example: bench {entry.group} {entry.name} {entry.example}")(
        getattr(import_module(entry.module), entry.function)
    )
    return typer.main.get_command(single)
