"""YAML of others: its size is looked at while it is scanned, before anything is built of it.

An alias stands for all that its anchor names, so a kilobyte can say a billion values.
"""

from __future__ import annotations

import warnings
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, NodeEvent

from synth.errors import UserError

LARGEST_BYTES = 200_000
_MOST_VALUES = 10_000
_DEEPEST = 32
_LARGEST_NUMBER = 1 << 64


def load(text: str, label: str) -> Any:
    """The tree of a text, with places and comments (`ruamel.yaml`'s round trip); `plain` is its values.

    Args:
        text: YAML 1.2.
        label: names it in messages.

    Raises:
        UserError: `label:line:column: ...`: no YAML, too large, nested too deep, or it stands for too much.
    """
    if len(text) > LARGEST_BYTES:
        raise UserError(f"{label}: {len(text)} characters are too many, at most {LARGEST_BYTES} are read")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of anchors used again, which YAML allows
            _refuse_too_much(text, label)
            return YAML(typ="rt").load(text)
    except UserError:
        raise
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{label}:{mark.line + 1}:{mark.column + 1}" if mark else label
        raise UserError(f"{where}: not YAML: {_first_line(error.problem or error.context)}") from None
    except Exception as error:  # the reader raises bare ValueErrors and others for odd scalars and tags
        raise UserError(f"{label}: not YAML: {_first_line(error)}") from error


def plain(value: Any, label: str) -> Any:
    """A tree of `load` as dictionaries with keys of text, lists, texts, numbers, booleans and None.

    Dates, for which YAML takes what looks like one, are their text.

    Raises:
        UserError: a number beyond 64 bits, or a value of another kind (`!!binary`, `!!set`, a tag).
    """
    if isinstance(value, dict):
        return {_key(key): plain(item, label) for key, item in value.items()}
    if isinstance(value, list):
        return [plain(item, label) for item in value]
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int):
        if abs(value) > _LARGEST_NUMBER:
            digits = int(value.bit_length() * 0.30103) + 1
            raise UserError(f"{label}: a whole number of {digits} digits is too large")
        return int(value)
    for kind in (float, str):
        if isinstance(value, kind):
            return kind(value)
    if hasattr(value, "isoformat"):
        return str(value)
    raise UserError(f"{label}: a value of a kind that is not read ({type(value).__name__})")


def _refuse_too_much(text: str, label: str) -> None:
    """UserError if the text is nested deeper, or stands for more values, than any file of ours."""
    begun: list[tuple[str | None, int]] = []  # collections being read: anchor, values before them
    sizes: dict[str, int] = {}
    values = 0
    for event in YAML(typ="rt").parse(text):
        if isinstance(event, CollectionEndEvent):
            anchor, before = begun.pop()
            if anchor is not None:
                sizes[anchor] = values - before
            continue
        if not isinstance(event, NodeEvent):
            continue
        anchor, place = event.anchor, f"{label}:{event.start_mark.line + 1}:{event.start_mark.column + 1}"
        if isinstance(event, AliasEvent):
            if any(name == anchor for name, _ in begun):
                raise UserError(f"{place}: *{anchor} stands for what it lies in")
            values += sizes.get(anchor, 0)
        elif isinstance(event, CollectionStartEvent):
            begun.append((anchor, values))
        elif anchor is not None:
            sizes[anchor] = 1
        values += 1
        if len(begun) > _DEEPEST:
            raise UserError(f"{place}: nested deeper than {_DEEPEST} levels")
        if values > _MOST_VALUES:
            raise UserError(f"{place}: stands for more than {_MOST_VALUES} values")


def _key(key: Any) -> str:
    return key if type(key) is str else str(key)[:100]


def _first_line(error: Any) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
