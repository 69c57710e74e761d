"""Errors of the machine end a command with one line and exit code 2; bugs have a traceback."""

import errno

import pytest
import typer
from typer.testing import CliRunner

from synth.errors import UserError
from synth.system.cli_errors import Commands


def run_failing(error: BaseException) -> tuple[int, str, BaseException | None]:
    app = typer.Typer(cls=Commands)

    @app.command()
    def fail() -> None:
        raise error

    @app.command()
    def other() -> None:
        """A second command: with one alone there is no group."""

    result = CliRunner().invoke(app, ["fail"])
    return result.exit_code, result.stderr, result.exception


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "a/score.json"), "a/score.json: No space left"),
        (OSError(errno.EACCES, "Permission denied", "a"), "Permission denied"),
        (OSError(errno.EDQUOT, "Disk quota exceeded", "a"), "Disk quota exceeded"),
        (ModuleNotFoundError("No module named 'sklearn'", name="sklearn.metrics"), "pip install '.[bench]'"),
        (MemoryError(), "memory"),
    ],
)
def test_errors_of_the_machine_are_one_line(error: Exception, message: str) -> None:
    code, errors, _ = run_failing(error)
    assert (code, errors.count("\n")) == (2, 1)
    assert message in errors


def test_control_characters_of_names_are_escaped() -> None:
    assert run_failing(UserError("a\x1b[31m\nb\u202e"))[:2] == (2, "error: a\\x1b[31m\nb\\u202e\n")


OWN_MODULE = ModuleNotFoundError("No module named 'synth.shop'", name="synth.shop")


@pytest.mark.parametrize("error", [OSError(errno.EIO, "Input/output error"), ValueError("a bug"), OWN_MODULE])
def test_bugs_are_not_hidden(error: Exception) -> None:
    assert run_failing(error) == (1, "", error)
