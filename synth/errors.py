"""Errors that a person caused and can mend: one clear line, exit code 2, no traceback."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class UserError(Exception):
    """Something in the job, the input or the machine that the user can put right.

    The message is complete without a traceback; several problems are several lines. Command lines print it
    to stderr and exit with code 2.
    """


class InvalidValue(UserError, ValueError):
    """A value that can't be: of a key, it is reported where the key stands."""


class NotFinite(UserError):
    """A computed value is NaN or infinite: the sequence is stopped and marked failed."""


class Caution(UserWarning):
    """Something that the user should know, though nothing is refused; command lines print it to stderr."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`; did you mean 'x'?`, or nothing where no known word is near."""
    close = difflib.get_close_matches(word[:80], list(known), 1)
    return f"; did you mean '{close[0]}'?" if close else ""


@contextmanager
def as_user_error(label: str) -> Iterator[None]:
    """Makes one line after `label` of whatever the block raises: for code and formats of others.

    Their `sys.exit` too; what is too little memory stays that.
    """
    try:
        yield
    except UserError as error:
        raise UserError(f"{label}: {error}") from error
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:
        why = getattr(error, "strerror", None) or f"{type(error).__name__}: {first_line(error)}"
        raise UserError(f"{label}: {why}") from error


def first_line(error: object) -> str:
    """What an error says in its first line; its name where it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
