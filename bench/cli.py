"""The `bench` command."""

from __future__ import annotations

import typer

from bench.rooms import Rooms

app = typer.Typer(
    name="bench",
    help="Measures: recordings against force sensors, methods against one another.",
    no_args_is_help=True,
    add_completion=False,
)

for _name, _help in (
    ("pareto", "Speed against accuracy of one room's choices."),
    ("stability", "Where one room's methods break, and that they say so."),
    ("experiment", "One stated question about one room, answered with numbers."),
):
    app.add_typer(typer.Typer(name=_name, cls=Rooms, help=_help, no_args_is_help=True))
