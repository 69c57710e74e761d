"""Errors and exit codes of all commands: bad input is one line and code 2, Ctrl-C is 130, a closed pipe 0."""

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

_MACHINE = {  # errors caused by the state of the machine, not by a bug
    errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR,
    errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP, errno.EMFILE, errno.ENFILE,
}  # fmt: skip


def printable(text: str) -> str:
    """A message with control characters escaped: the name of a file must not control the terminal."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


class Commands(TyperGroup):
    """A typer group (`typer.Typer(cls=Commands)`) that turns a UserError into its message and exit code 2."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Writes the commands with their whole first sentences, which click would truncate."""
        commands = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, command.get_short_help_str(1000)) for name, command in commands if command]
            )

    def invoke(self, ctx: Any) -> Any:
        try:
            with _cautions():
                return super().invoke(ctx)
        except UserError as error:
            message = str(error)
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package in ("fcntl", "resource"):  # of Unix
                message = "this command runs on Linux only; synth doctor says what to use instead"
            elif package == "sklearn":  # the one that a plain installation lacks
                message = "package sklearn is missing: pip install '.[bench]' in the clone"
            else:
                raise
        except KeyboardInterrupt:
            typer.echo("stopped", err=True)
            raise typer.Exit(130) from None
        except BrokenPipeError:
            # The reading process has ended (`| head`): buffered output must not raise again at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(0) from None
        except OSError as error:
            if error.errno not in _MACHINE:
                raise
            message = ": ".join(str(part) for part in (error.filename, error.strerror) if part is not None)
        except MemoryError:
            message = "out of memory: use a smaller size or fewer workers"
        typer.echo(f"error: {printable(message)}", err=True)
        raise typer.Exit(2)


@contextmanager
def _cautions() -> Iterator[None]:
    """Prints each `Caution` as a line; other warnings are unchanged."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def print_warning(
            message: Warning | str, category: type[Warning], *details: Any, **options: Any
        ) -> None:
            if issubclass(category, Caution):
                typer.echo(f"note: {printable(str(message))}", err=True)
            else:
                show(message, category, *details, **options)

        warnings.showwarning = print_warning
        yield
