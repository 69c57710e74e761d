"""`python -m evidence STUDY`, and `all`, `status`, `guard`."""

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from evidence import all as everything
from evidence import report, study
from evidence import result_status as states
from evidence.guard import guard


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


app.command("guard")(guard.main)


@app.command()
def status(
    write: Annotated[bool, typer.Option(help="Writes each state on the page of its result.")] = False,
) -> None:
    """Whether each stored result stands, or by how much what it depends on has moved; and how it was made."""
    if write:
        states.write_states()
    typer.echo(report.markdown([result.row() for result in states.gather()]))


if __name__ == "__main__":
    app(prog_name="python -m evidence")
