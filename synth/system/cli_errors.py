"""How every command ends: bad input is one line and exit code 2, Ctrl-C is 130, a closed pipe is quiet."""

from __future__ import annotations

import errno
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer
from typer.core import TyperGroup

from synth.errors import Caution, UserError

# What the state of the machine is to blame for, and no mistake of the program.
_MACHINE = {
    errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR,
    errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP, errno.EMFILE, errno.ENFILE,
}  # fmt: skip

_EXTRAS = {"sklearn": "bench"}
"""Packages that commands import and a plain installation lacks, and the extra that brings them."""


def printable(text: str) -> str:
    """A message with control characters spelt out: what a file is called must not steer a terminal."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


class Commands(TyperGroup):
    """A typer group (`typer.Typer(cls=Commands)`) that turns UserError into its line and exit code 2."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """The commands with all of their first sentences, wrapped where click would cut them off."""
        commands = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [(name, one.get_short_help_str(1000)) for name, one in commands if one and not one.hidden]
        if rows:
            with formatter.section("Commands"):
                formatter.write_dl(rows)

    def invoke(self, ctx: Any) -> Any:
        try:
            with _cautions():
                return super().invoke(ctx)
        except UserError as error:
            typer.echo(f"error: {printable(str(error))}", err=True)
            raise typer.Exit(2) from None
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package not in _EXTRAS:
                raise
            extra = _EXTRAS[package]
            how = f"pip install '.[{extra}]' in the clone"
            typer.echo(f"error: this needs the package {package}, of the extra {extra}: {how}", err=True)
            raise typer.Exit(2) from None
        except KeyboardInterrupt:
            typer.echo("stopped", err=True)
            raise typer.Exit(130) from None
        except BrokenPipeError:
            # The reader has gone (`| head`): what is still buffered must not raise again at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(0) from None
        except OSError as error:
            if error.errno not in _MACHINE:
                raise
            where = f"{error.filename}: " if error.filename is not None else ""
            typer.echo(f"error: {printable(where)}{error.strerror}", err=True)
            raise typer.Exit(2) from None
        except MemoryError:
            typer.echo("error: the memory of this machine is not enough for that", err=True)
            raise typer.Exit(2) from None


@contextmanager
def _cautions() -> Iterator[None]:
    """Shows a `Caution` as a line; other warnings as ever."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def say(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, Caution):
                typer.echo(f"note: {printable(str(message))}", err=True)
            else:
                show(message, category, *where, **more)

        warnings.showwarning = say
        yield
