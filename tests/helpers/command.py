"""Commands run in this process."""

from click.testing import Result
from typer import Typer
from typer.testing import CliRunner


def run(app: Typer, *words: object, code: int = 0) -> Result:
    """The result of a command, which must end with `code`."""
    result = CliRunner().invoke(app, [*map(str, words)])
    assert result.exit_code == code, (result.output, result.exception)
    return result
