"""Commands run in this process."""

from click.testing import Result
from typer import Typer
from typer.testing import CliRunner


def run(app: Typer, *words: object, code: int = 0) -> Result:
    """The result of a command, which must end with `code`."""
    done = CliRunner().invoke(app, [*map(str, words)])
    assert done.exit_code == code, (done.output, done.exception)
    return done
