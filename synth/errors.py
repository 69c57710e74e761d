"""Errors that a person caused and can mend: one clear line, exit code 2, no traceback."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from numbers import Real
from pathlib import Path


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


def as_path(what: str, value: object) -> Path:
    """`value` as a path; UserError that names `what` for anything that can't be one."""
    if not isinstance(value, (str, Path)):
        raise UserError(f"{what}: expected a path, got {type(value).__name__}")
    return Path(value)


def as_positive(what: str, value: object, largest: float = math.inf) -> float:
    """`value` as a finite number above 0 and at most `largest`; UserError that names `what` for another."""
    number = float(value) if isinstance(value, Real) else math.nan
    if not (0 < number <= largest and math.isfinite(number)):
        most = f" and at most {largest:g}" if math.isfinite(largest) else ""
        raise UserError(f"{what} {value!r}: must be a number above 0{most}")
    return number


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
