"""Configuration by pydantic models: YAML text and `section.key=value` overrides, errors with their line."""

from __future__ import annotations

import io
import math
import typing
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError
from ruamel.yaml import YAML

from synth.errors import UserError, did_you_mean, first_line
from synth.system import checked_file

Model = TypeVar("Model", bound=BaseModel)
T = TypeVar("T")

Loc = tuple[str | int, ...]  # path of a value in a configuration: keys and list positions


@dataclass(frozen=True)
class Mistake:
    """An error in a configuration."""

    loc: Loc
    what: str

    def __str__(self) -> str:
        return f"{join_loc(self.loc)}: {self.what}" if self.loc else self.what


class ConfigFile:
    """The values of a YAML text, overrides of them, and the line of each."""

    def __init__(self, text: str, label: str) -> None:
        """Raises UserError if `text` is not a YAML mapping. `label` names it in messages."""
        self.values: dict[str, Any] = checked_file.load_yaml(text, label)
        if not isinstance(self.values, dict):
            raise UserError(f"{label}:1:1: a block of `key: value` lines is needed")
        self._label, self._tree = label, checked_file.load_yaml(text, label, places=True)
        self.changes: dict[Loc, str] = {}  # the override that set a value, as text

    def change(self, changes: Iterable[str]) -> None:
        """Replaces values by `section.key=value`, the value in YAML. UserError for other text."""
        for text in changes:
            key, equals, value = text.partition("=")
            loc: Loc = tuple(key.strip().split("."))
            if not equals or not all(loc):
                raise UserError(f"{text}: an override is written section.key=value")
            new_value = checked_file.load_yaml(value, text)
            for tree in (self.values, self._tree):
                block: Any = tree
                for step in loc[:-1]:
                    if not isinstance(block.get(step), dict):
                        block[step] = type(block)()
                    block = block[step]
                block[loc[-1]] = new_value
            self.changes[loc] = text

    def dump(self) -> str:
        """The YAML text with its comments and with the changes."""
        out, yaml = io.StringIO(), YAML(typ="rt")
        yaml.width = 110
        yaml.dump(self._tree, out)
        return out.getvalue()

    def validate(self, model: type[Model], further: Iterable[Mistake] = ()) -> Model:
        """The validated model. UserError: a line for each error, and `further` ones, in the file's order:
        `job.yaml:12:3: render.sppp: unknown key; did you mean 'spp'?`"""
        mistakes, instance = list(further), None
        try:
            instance = model.model_validate(self.values)
        except ValidationError as error:
            mistakes += _find_mistakes(error, model, self.values)
        if mistakes or instance is None:
            lines = sorted({(*self._place(mistake.loc), str(mistake)) for mistake in mistakes})
            raise UserError("\n".join(f"{position}{message}" for _, position, message in lines))
        return instance

    def _place(self, loc: Loc) -> tuple[float, str]:
        """Sorting key and text of an error's place: an override, or a line and column of the file."""
        block, line, column, missing = self._tree, 0, 0, False
        for step in loc:
            positions = getattr(getattr(block, "lc", None), "data", None) or {}
            missing = step not in positions
            if missing:
                break
            line, column = positions[step][:2]
            block = block[step]
        for place, text in self.changes.items():  # for an unknown section: a part of an override
            if loc[: len(place)] == place or (missing and place[: len(loc)] == loc):
                return math.inf, f"'{text}': "
        return line, f"{self._label}:{line + 1}:{column + 1}: " if self._label else ""


def override(settings: Model, changes: Iterable[str]) -> Model:
    """`settings` with `key=value` or `section.key=value` replaced. UserError: one line for each error."""
    config = ConfigFile("{}", "")
    config.values = settings.model_dump(exclude_unset=True)
    config.change(changes)
    return config.validate(type(settings))


def first_mistake(error: ValidationError) -> str:
    """The first error in a file that a program wrote, in one line."""
    detail = error.errors(include_url=False)[0]
    return first_line(Mistake(detail["loc"], detail["msg"]))


def validate_values(kind: type[T], values: Any, label: str, context: object = None) -> T:
    """`values` as a model or dataclass. UserError: `label`, with the first mistake in parentheses."""
    try:
        return TypeAdapter(kind).validate_python(values, context=context)
    except ValidationError as error:
        raise UserError(f"{label} ({first_mistake(error)})") from None


def _find_mistakes(
    error: ValidationError, model: type[BaseModel], values: dict[str, Any]
) -> Iterator[Mistake]:
    """pydantic's messages with their paths in `values`; for an unknown key with a suggestion."""
    messages: dict[Loc, list[str]] = {}
    errors = error.errors(include_url=False)
    for detail in errors:
        if detail["type"] == "too_short" and any(other["loc"][:-1] == detail["loc"] for other in errors):
            continue  # what is wrong is an item, not their number
        block: Any = values
        loc: Loc = ()
        for step in detail["loc"]:  # in which pydantic includes names of validators and members of unions
            steps = range(len(block)) if isinstance(block, list | tuple) else block
            if isinstance(steps, range | dict) and step in steps:
                loc, block = (*loc, step), block[step]
        if detail["type"] == "missing":
            loc = (*loc, detail["loc"][-1])
        unknown = detail["type"] == "extra_forbidden"
        message = detail["msg"].removeprefix("Value error, ")
        if unknown:
            message = f"unknown key{_suggest_key(loc, model)}"
        messages.setdefault(loc, []).append(message)
    return (Mistake(loc, ", or ".join(dict.fromkeys(texts))) for loc, texts in messages.items())


def _suggest_key(loc: Loc, model: type[BaseModel]) -> str:
    """A suggestion for an unknown key: a similar one in its block, or the same in another block."""
    keys = list_keys(model)
    elsewhere = [join_loc(place) for place in keys if place[-1] == loc[-1]]
    hint = did_you_mean(str(loc[-1]), [str(place[-1]) for place in keys if place[:-1] == loc[:-1]])
    return hint or (f"; did you mean '{elsewhere[0]}'?" if elsewhere else "")


def section_of(annotation: Any) -> type[BaseModel] | None:
    """The model in a field's type (also if optional), if any."""
    options = (annotation, *typing.get_args(annotation))
    return next(
        (option for option in options if isinstance(option, type) and issubclass(option, BaseModel)), None
    )


def list_keys(model: type[BaseModel], loc: Loc = ()) -> list[Loc]:
    """All keys of a model, except in lists: ("seed",), ("render",), ("render", "spp"), ..."""
    keys: list[Loc] = []
    for name, field in model.model_fields.items():
        keys.append((*loc, name))
        inner = section_of(field.annotation)
        if inner is not None and typing.get_origin(field.annotation) is not tuple:
            keys += list_keys(inner, (*loc, name))
    return keys


def join_loc(loc: Loc) -> str:
    """A path as text: `fem.load[1]`."""
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in loc).removeprefix(".")
