"""`python -m evidence STUDY`, `python -m evidence all`, `python -m evidence status`."""

from typing import Any

import typer
from typer.core import TyperGroup

from evidence import all as everything
from evidence import report, study
from evidence.status import gather


class _Studies(TyperGroup):
    """The commands below, and one for each study, imported when it is run."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*super().list_commands(ctx), *study.names()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        return study.command(cmd_name) if cmd_name in study.names() else super().get_command(ctx, cmd_name)


app = typer.Typer(cls=_Studies, no_args_is_help=True, add_completion=False)
app.command("all")(everything.main)


@app.callback()
def main() -> None:
    """This project's own measurements."""


@app.command()
def status() -> None:
    """For each stored result: current or stale, commit, CPU-hours to make it again, command."""
    modules = {study.load(name).result: f"evidence.{name}" for name in study.names()}
    typer.echo(report.markdown([one.row() for one in gather(report.RESULTS, modules)]))


if __name__ == "__main__":
    app(prog_name="python -m evidence")
