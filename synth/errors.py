"""Errors that the user caused and can fix: one clear line, exit code 2, no traceback."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from numbers import Real


class UserError(Exception):
    """Something in the job, the input or the machine that the user can fix; problems are a line each."""


class InvalidValue(UserError, ValueError):
    """A value that is not allowed; for a key of a configuration it is reported with the key's line."""


class NotFinite(UserError):
    """A computed value is NaN or infinite: the sequence is stopped and marked failed."""


class Caution(UserWarning):
    """A warning for the user, who can continue; command lines print it to stderr."""


def as_positive(what: str, value: object, largest: float = math.inf) -> float:
    """`value` as a finite number above 0 and at most `largest`; UserError that names `what` for another."""
    number = float(value) if isinstance(value, Real) else math.nan
    if not (0 < number <= largest and math.isfinite(number)):
        most = f" and at most {largest:g}" if math.isfinite(largest) else ""
        raise UserError(f"{what} {value!r}: must be a number above 0{most}")
    return number


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`; did you mean 'x'?`, or an empty text if no known word is similar."""
    close = difflib.get_close_matches(word[:80], list(known), 1)
    return f"; did you mean '{close[0]}'?" if close else ""


@contextmanager
def as_user_error(label: str) -> Iterator[None]:
    """Turns any exception in the block but MemoryError into a one-line UserError that begins with `label`."""
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
    """The first line of an error's message; the name of its type if the message is empty."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
