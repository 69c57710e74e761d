"""How commands end that the machine is to blame for: a line and exit code 2. Our mistakes keep a trace."""

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
        """A second one, for with one alone there is no group."""

    done = CliRunner().invoke(app, ["fail"])
    return done.exit_code, done.stderr, done.exception


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EROFS, errno.ENOTDIR, errno.EDQUOT])
def test_a_full_or_barred_disk_is_one_line(number: int) -> None:
    code, said, _ = ended(OSError(number, os.strerror(number), "out/score.json"))
    assert (code, said) == (2, f"error: out/score.json: {os.strerror(number)}\n")


def test_a_package_of_an_extra_is_named_with_it() -> None:
    code, said, _ = ended(ModuleNotFoundError("No module named 'sklearn'", name="sklearn.metrics"))
    assert (code, said.count("\n")) == (2, 1)
    assert "pip install '.[bench]'" in said
    _, _, trace = ended(ModuleNotFoundError("No module named 'synth.shop'", name="synth.shop"))
    assert isinstance(trace, ModuleNotFoundError), "a module of ours that is missing is our mistake"


def test_too_little_memory_is_one_line() -> None:
    code, said, _ = ended(MemoryError())
    assert (code, said.count("\n")) == (2, 1)


def test_control_characters_of_names_are_spelt_out() -> None:
    assert ended(UserError("a\x1b[31m\nb\u202e"))[:2] == (2, "error: a\\x1b[31m\nb\\u202e\n")


@pytest.mark.parametrize("error", [OSError(errno.EIO, "Input/output error"), ValueError("ours")])
def test_what_is_a_mistake_of_ours_is_not_hidden(error: Exception) -> None:
    code, said, raised = ended(error)
    assert (code, said, raised) == (1, "", error)
