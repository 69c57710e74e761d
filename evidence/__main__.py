"""`python -m evidence status`: what made each stored result, and whether that has changed since."""

from __future__ import annotations

import typer

from evidence import report
from evidence.status import gather

app = typer.Typer(no_args_is_help=True, add_completion=False)


@app.callback()
def main() -> None:
    """This project's own measurements; each is a script: python -m evidence.PACKAGE.NAME."""


@app.command()
def status() -> None:
    """For each stored result: current or stale, commit, CPU-hours to make it again, command."""
    report.show({"stored results": [one.row() for one in gather(report.RESULTS)]})


if __name__ == "__main__":
    app(prog_name="python -m evidence")
