"""Errors of the machine end a command with one line and exit code 2; bugs have a traceback."""

from __future__ import annotations

import errno
import os

import pytest
import typer
from typer.testing import CliRunner

from synth.errors import UserError
from synth.system.cli_errors import Commands


def ended(error: BaseException) -> tuple[int, str, BaseException | None]:
    app = typer.Typer(cls=Commands)

    @app.command()
    def fail() -> None:
        raise error

    @app.command()
    def other() -> None:
        """A second command: with one alone there is no group."""

    done = CliRunner().invoke(app, ["fail"])
    return done.exit_code, done.stderr, done.exception


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EROFS, errno.ENOTDIR, errno.EDQUOT])
def test_a_full_or_readonly_disk_is_one_line(number: int) -> None:
    code, errors, _ = ended(OSError(number, os.strerror(number), "out/score.json"))
    assert (code, errors) == (2, f"error: out/score.json: {os.strerror(number)}\n")


def test_missing_packages_and_memory_are_one_line() -> None:
    code, errors, _ = ended(ModuleNotFoundError("No module named 'sklearn'", name="sklearn.metrics"))
    assert (code, errors.count("\n")) == (2, 1)
    assert "pip install '.[bench]'" in errors
    code, errors, _ = ended(MemoryError())
    assert (code, errors.count("\n")) == (2, 1)


def test_control_characters_of_names_are_escaped() -> None:
    assert ended(UserError("a\x1b[31m\nb\u202e"))[:2] == (2, "error: a\\x1b[31m\nb\\u202e\n")


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.EIO, "Input/output error"),
        ValueError("a bug"),
        ModuleNotFoundError("No module named 'synth.shop'", name="synth.shop"),
    ],
)
def test_bugs_are_not_hidden(error: Exception) -> None:
    assert ended(error) == (1, "", error)
