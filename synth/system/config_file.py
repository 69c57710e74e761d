"""Configuration by pydantic models: YAML text and `section.key=value` changes, each mistake at its place."""

from __future__ import annotations

import math
import re
import reprlib
import typing
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from synth.errors import UserError, did_you_mean
from synth.system import checked_file

Model = TypeVar("Model", bound=BaseModel)

Loc = tuple[str | int, ...]
"""A place in a configuration: keys and positions from the top."""

_MOST_MISTAKES = 20
_DEEPEST = 8  # keys of a change, one in another
_LONG = 80  # characters of a value in a message

_ADDED = re.compile(r"[\w-]+\[.*\]|constrained-\w+")
_UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")


@dataclass(frozen=True)
class Mistake:
    """Something in a configuration that can't be."""

    at: Loc
    what: str
    of_key: bool = False
    """Whether the key itself is wrong, and not its value."""

    def __str__(self) -> str:
        return f"{dotted(self.at)}: {self.what}" if self.at else self.what


class ConfigFile:
    """The values of a YAML text, changes made to them, and where each of them stands."""

    def __init__(self, text: str, label: str) -> None:
        """Raises UserError for what is no YAML, or no block of keys. `label` names the text in messages."""
        tree = checked_file.load_yaml(text, label)
        if not isinstance(tree, CommentedMap):
            raise UserError(f"{label}:1:1: a block of `key: value` lines is needed")
        self._label, self._tree = label, tree
        self.values: dict[str, Any] = checked_file.plain_yaml(tree, label)
        self.changes: dict[Loc, str] = {}
        """The text of the change that gave a place its value."""

    def change(self, changes: Iterable[str]) -> None:
        """Replaces values by `section.key=value`, the value in YAML. UserError for what is none of that."""
        for text in changes:
            key, equals, value = text.partition("=")
            at: Loc = tuple(key.strip().split("."))
            if not equals or not all(at) or len(at) > _DEEPEST:
                raise UserError(f"{_cut(text)}: an override is written section.key=value")
            block: Any = self.values
            for step in at[:-1]:
                if not isinstance(block.get(step), dict):
                    block[step] = {}
                block = block[step]
            tree = checked_file.load_yaml(value, _cut(text)) if value.strip() else None
            block[at[-1]] = checked_file.plain_yaml(tree, _cut(text))
            self.changes[at] = text

    def validate(self, model: type[Model], further: Iterable[Mistake] = ()) -> Model:
        """The model of the values.

        Raises:
            UserError: a line for each mistake, and each of the `further` ones, in the order of the file:
                `job.yaml:12:3: render.sppp: unknown key; did you mean 'spp'?`
        """
        mistakes, made = list(further), None
        try:
            made = model.model_validate(self.values)
        except ValidationError as error:
            mistakes += find_mistakes(error, model)
        if mistakes or made is None:
            lines = sorted({(*self._place(one), str(one)) for one in mistakes})
            raise UserError("\n".join(f"{where}{what}" for _, where, what in lines))
        return made

    def _place(self, mistake: Mistake) -> tuple[float, str]:
        """Order and text of where a mistake stands: in a change, or at a line and column of the file."""
        at = mistake.at
        change = next((self.changes[at[:n]] for n in range(len(at), 0, -1) if at[:n] in self.changes), None)
        block: Any = self._tree
        line = column = 0
        for depth, step in enumerate(at, 1):
            if isinstance(block, CommentedMap) and step in block:
                inner = isinstance(block[step], CommentedMap | CommentedSeq)
                of_key = mistake.of_key if depth == len(at) else inner
                line, column = block.lc.key(step) if of_key else block.lc.value(step)
            elif isinstance(block, CommentedSeq) and isinstance(step, int) and step < len(block):
                line, column = block.lc.item(step)
            else:  # not in the file, but perhaps a part of a change: `rendr` of `rendr.spp=3`
                parts = (text for place, text in self.changes.items() if place[: len(at)] == at)
                change = change or next(parts, None)
                break
            block = block[step]
        if change is not None:
            return math.inf, f"'{change}': "
        return line, f"{self._label}:{line + 1}:{column + 1}: " if self._label else ""


def override(settings: Model, changes: Iterable[str]) -> Model:
    """`settings` with `key=value` or `section.key=value` replaced, the value in YAML.

    Raises UserError: one line for every mistake, `'batch=many': batch: 'many' should be ...`.
    """
    config = ConfigFile("{}", "")
    config.values = settings.model_dump(exclude_unset=True)
    config.change(changes)
    return config.validate(type(settings))


def first_mistake(error: ValidationError, model: type[BaseModel] | None = None) -> Mistake:
    """The first thing that is wrong in a file that a program wrote."""
    return next(find_mistakes(error, model))


def find_mistakes(error: ValidationError, model: type[BaseModel] | None = None) -> Iterator[Mistake]:
    """What is wrong, in words for the person who wrote it; `model` knows the keys that were meant."""
    found = error.errors(include_url=False)[:_MOST_MISTAKES]
    blocks = {_trimmed(one["loc"])[:-1] for one in found}
    said: dict[Loc, Mistake] = {}
    for one in found:
        at = _trimmed(one["loc"])
        if one["type"] == "too_short" and at in blocks:  # only right items count: the wrong ones are named
            continue
        what = _reword(one, at, model)
        if at in said:  # what else might stand there
            what = f"{said[at].what}, or {what.partition(' ')[2]}"
        said[at] = Mistake(at, what, of_key=one["type"] in _UNKNOWN_KEY)
    yield from said.values()


def _reword(error: Mapping[str, Any], at: Loc, model: type[BaseModel] | None) -> str:
    """pydantic's words, with what was meant and what stands there."""
    kind, context = str(error["type"]), error.get("ctx", {})
    if kind in _UNKNOWN_KEY:
        return f"unknown key{_meant(at, model)}"
    if kind == "value_error":  # a validator of ours
        return _cut(str(context["error"]), 4 * _LONG)
    what = str(error["msg"]).splitlines()[0][:200].removeprefix("Input ")
    if kind in ("missing", "too_short", "too_long"):
        return what.lower()
    hint = ""
    if kind == "literal_error":
        hint = did_you_mean(str(error["input"]), str(context["expected"]).split("'")[1::2])
    elif re.fullmatch(r"-?\d*,\d+", str(error["input"])):
        hint = f"; did you mean {error['input'].replace(',', '.')}?"
    return f"{_short(error['input'])} {what}{hint}"


def _meant(at: Loc, model: type[BaseModel] | None) -> str:
    """Which key an unknown one may stand for: one of its block, or the same in another block."""
    if model is None:
        return ""
    block = model
    for step in at[:-1]:
        if isinstance(step, str) and step in block.model_fields:
            block = section_of(block.model_fields[step].annotation) or block
    elsewhere = [dotted(place) for place in places(model) if place[-1] == at[-1]]
    hint = did_you_mean(str(at[-1]), block.model_fields)
    if not hint and elsewhere:
        hint = f"; did you mean '{elsewhere[0]}'?"
    return hint or f"; known are {', '.join(block.model_fields)}"


def section_of(annotation: Any) -> type[BaseModel] | None:
    """The model that a field's type is (or may be), if any."""
    for option in (annotation, *typing.get_args(annotation)):
        if isinstance(option, type) and issubclass(option, BaseModel):
            return option
    return None


def places(model: type[BaseModel], at: Loc = ()) -> list[Loc]:
    """Every key of a model, from the top: ("seed",), ("render",), ("render", "spp"), ... but not in lists."""
    found: list[Loc] = []
    for name, field in model.model_fields.items():
        found.append((*at, name))
        inner = section_of(field.annotation)
        if inner is not None and typing.get_origin(field.annotation) is not tuple:
            found += places(inner, (*at, name))
    return found


def dotted(at: Loc) -> str:
    """A place as it is written: `fem.load[1]`."""
    text = ""
    for step in at:
        if isinstance(step, int):
            text += f"[{step}]"
        else:
            text += ("." if text else "") + _cut(step if step.isprintable() else repr(step))
    return _cut(text, 200)


def _trimmed(loc: Loc) -> Loc:
    """The place without the names that pydantic adds for validators and unions."""
    own = tuple(step for step in loc if isinstance(step, int) or not _ADDED.fullmatch(step))
    return own or loc  # a key may look so too


def _short(value: Any) -> str:
    """A value as it would be written, its middle left out where it is long."""
    shortened = reprlib.Repr()
    shortened.maxstring = shortened.maxother = _LONG
    return shortened.repr(value)


def _cut(text: str, most: int = _LONG) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."
