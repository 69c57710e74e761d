"""Reading a job: a YAML file or a named job plus `a.b=c` overrides; each mistake is reported at its place."""

from __future__ import annotations

import difflib
import os
import re
import reprlib
import typing
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from synth.errors import UserError
from synth.job import identity, retired
from synth.job.schema import Job
from synth.system import checked_file

Model = TypeVar("Model", bound=BaseModel)

Loc = tuple[str | int, ...]
"""Where in the job: keys and positions from the top."""

_MOST_MISTAKES = 20
_DEEPEST = 8  # keys of an override, one in another
_LONG = 80

_KINDS = {
    "int_parsing": "a whole number is needed",
    "int_type": "a whole number is needed",
    "int_from_float": "a whole number is needed",
    "float_parsing": "a number is needed",
    "float_type": "a number is needed",
    "finite_number": "a finite number is needed",
    "bool_parsing": "true or false is needed",
    "bool_type": "true or false is needed",
    "string_type": "a text is needed",
    "path_type": "a file name is needed",
    "tuple_type": "a list is needed",
    "model_type": "a block of keys is needed",
}


def names() -> list[str]:
    """Jobs that come with the program."""
    jobs = resources.files("synth.job") / "named"
    return sorted(
        entry.name.removesuffix(".yaml") for entry in jobs.iterdir() if entry.name.endswith(".yaml")
    )


def load_job(source: str, overrides: Sequence[str] = ()) -> Job:
    """The job in `source`, with overrides applied.

    Args:
        source: path of a job file, or one of `names()`. A path wins when it exists.
        overrides: `section.key=value`, the value in YAML. Relative paths in them start at the working
            directory, those in a file at the file.

    Raises:
        UserError: one line for every mistake, `job.yaml:12:3: render.sppp: unknown key, did you mean 'spp'?`
    """
    text, label, folder = read_source(source)
    return parse_job(text, label, folder, overrides)


def read_source(source: str) -> tuple[str, str, Path]:
    """Text of a job file or named job, its name in messages, and where its relative paths start."""
    if source in names() and not os.path.lexists(source):
        text = (resources.files("synth.job") / "named" / f"{source}.yaml").read_text("utf-8")
        return text, f"{source} (a named job)", Path.cwd()
    if not os.path.lexists(source):
        close = difflib.get_close_matches(source[:_LONG], names(), 1)
        hint = f"did you mean '{close[0]}'?" if close else f"nor a job called so ({', '.join(names())})"
        raise UserError(f"{_cut(source)}: no such file; {hint}")
    text = checked_file.read_text(Path(source), checked_file.LARGEST_YAML)
    return text, source, Path(source).resolve().parent


def parse_job(text: str, label: str, folder: Path, overrides: Sequence[str] = ()) -> Job:
    """The job in `text`; `label` names it in messages and its relative paths start at `folder`."""
    written = checked_file.load_yaml(text, label)
    if not isinstance(written, CommentedMap):
        raise UserError(f"{label}:1:1: a job is a block of `key: value` lines")
    values = checked_file.plain_yaml(written, label)
    given = _apply(values, overrides)
    values, gone = retired.drop(values, retired.JOB)
    problems = []
    for key, value in gone.items():
        problems.append(
            (*_place(written, tuple(key.split(".")), label, given, key=True), retired.reason(key, value))
        )
    for at, largest in identity.FILES.items():
        base = Path.cwd() if at in given else folder
        what = _resolve(values, at, base, largest)
        problems += [(*_place(written, at, label, given), f"{_dotted(at)}{what}")] if what else []
    job = None
    try:
        job = Job.model_validate(values)
    except ValidationError as error:
        for at, unknown, what in _mistakes(error, Job):
            problems.append((*_place(written, at, label, given, key=unknown), what))
    if problems or job is None:
        lines = [f"{where}: {what}" for _, where, what in sorted(set(problems))]
        raise UserError("\n".join(lines))
    return job


def override(settings: Model, overrides: Iterable[str]) -> Model:
    """`settings` with `key=value` or `section.key=value` replaced, the value in YAML.

    Raises UserError: one line for every mistake, `'batch=many': batch: a whole number is needed, ...`.
    """
    values = settings.model_dump()
    given = _apply(values, overrides)
    try:
        return type(settings).model_validate(values)
    except ValidationError as error:
        lines = {f"{_given(given, at)}{what}" for at, _, what in _mistakes(error, type(settings))}
        raise UserError("\n".join(sorted(lines))) from None


def _given(given: dict[Loc, str], at: Loc) -> str:
    """The override that a mistake at `at` lies in; nothing when it takes several to make it."""
    touching = (text for place, text in given.items() if at and place[: len(at)] == at[: len(place)])
    return next((f"'{text}': " for text in touching), "")


def _mistakes(error: ValidationError, model: type[BaseModel]) -> Iterator[tuple[Loc, bool, str]]:
    """Where each mistake is, whether it is a key that is not known, and what to say of it."""
    found = error.errors(include_url=False)
    inside = {_trim(one["loc"])[:-1] for one in found[:_MOST_MISTAKES]}
    for one in found[:_MOST_MISTAKES]:
        at = _trim(one["loc"])
        if one["type"] == "too_short" and at in inside:  # only right items count: the wrong ones are named
            continue
        yield at, one["type"] == "extra_forbidden", f"{_dotted(at)}{_message(one, at, model)}"


def _apply(values: dict[Any, Any], overrides: Iterable[str]) -> dict[Loc, str]:
    """Puts overrides into `values`; returns the text that gave each place."""
    given: dict[Loc, str] = {}
    for text in overrides:
        dotted, equals, value = text.partition("=")
        at: Loc = tuple(dotted.strip().split("."))
        if not equals or not all(at) or len(at) > _DEEPEST:
            raise UserError(f"{_cut(text)}: an override is written section.key=value")
        block: Any = values
        for key in at[:-1]:
            if not isinstance(block.get(key), dict):
                block[key] = {}
            block = block[key]
        label = _cut(text)
        tree = checked_file.load_yaml(value, label) if value.strip() else None
        block[at[-1]] = checked_file.plain_yaml(tree, label)
        given[at] = text
    return given


def _resolve(values: dict[Any, Any], at: Loc, base: Path, largest: int) -> str:
    """Makes the path at `at` absolute; what is wrong with it, or nothing."""
    block: Any = values
    for key in at[:-1]:
        block = block.get(key) if isinstance(block, dict) else None
    if not isinstance(block, dict) or not isinstance(block.get(at[-1]), str):
        return ""
    try:
        path = (base / Path(block[at[-1]]).expanduser()).resolve()
        checked_file.check_file(path, largest)
    except UserError as error:
        return str(error)
    except (RuntimeError, ValueError, OSError):  # nobody's home, a NUL, a circle of links, too long a name
        return f"{_cut(repr(block[at[-1]]))} is no name of a file"
    block[at[-1]] = str(path)
    return ""


def _place(
    written: CommentedMap, at: Loc, label: str, given: dict[Loc, str], *, key: bool = False
) -> tuple[int, str]:
    """(order, text) of the place in the file or on the command line that gave `at`."""
    for length in range(len(at), 0, -1):
        if at[:length] in given:
            return (1 << 30, f"'{given[at[:length]]}'")
    block: Any = written
    line, column = 0, 0
    for depth, step in enumerate(at):
        if isinstance(block, CommentedMap) and step in block:
            last = depth == len(at) - 1
            line, column = block.lc.key(step) if (key and last) else block.lc.value(step)
            if not last and isinstance(block[step], (CommentedMap, CommentedSeq)):
                line, column = block.lc.key(step)
        elif isinstance(block, CommentedSeq) and isinstance(step, int) and step < len(block):
            line, column = block.lc.item(step)
        else:
            # Not in the file, but perhaps a part of what was given: `rendr` of `rendr.spp=3`.
            inside = [text for place, text in given.items() if place[: len(at)] == at]
            if inside:
                return (1 << 30, f"'{inside[0]}'")
            break
        block = block[step]
    return (line, f"{label}:{line + 1}:{column + 1}")


def _trim(loc: Loc) -> Loc:
    """The place without the names that pydantic adds for validators and unions."""
    kept = tuple(step for step in loc if isinstance(step, int) or not re.fullmatch(r"[\w-]+\[.*\]", step))
    return kept or loc  # a key may look so too


def _dotted(at: Loc) -> str:
    text = ""
    for step in at:
        name = _cut(step if str(step).isprintable() else repr(step)) if isinstance(step, str) else ""
        text += f".{name}" if name and text else name or f"[{step}]"
    return f"{text}: " if text else ""


def _message(error: Any, at: Loc, model: type[BaseModel]) -> str:
    kind, context = str(error["type"]), error.get("ctx", {})
    if kind == "extra_forbidden":
        return f"unknown key{_did_you_mean(at, model)}"
    if kind == "literal_error":
        given = str(error["input"])[:_LONG]
        close = difflib.get_close_matches(given, str(context["expected"]).split("'")[1::2], 1)
        return f"{_short(error['input'])} is not one of {context['expected']}" + (
            f"; did you mean '{close[0]}'?" if close else ""
        )
    if kind == "value_error":
        return _cut(str(context["error"]), 4 * _LONG)
    limits = {"greater_than": ">", "greater_than_equal": ">=", "less_than": "<", "less_than_equal": "<="}
    if kind in limits:
        limit = context[{">": "gt", ">=": "ge", "<": "lt", "<=": "le"}[limits[kind]]]
        return f"{_short(error['input'])} is out of range, it must be {limits[kind]} {limit:g}"
    if kind == "missing" and isinstance(at[-1], str):
        return "is missing"
    if kind in ("too_short", "too_long"):
        least = context.get("min_length")
        bound = f"at most {context.get('max_length')}" if least is None else f"at least {least}"
        return f"the list has the wrong length, it needs {bound}"
    if kind == "missing":
        return f"the list has the wrong length ({error['msg'].lower()})"
    return f"{_KINDS.get(kind, error['msg'])}, not {_short(error['input'])}"


def _short(value: Any) -> str:
    """A value as it would be written, its middle left out where it is long."""
    shortened = reprlib.Repr()
    shortened.maxstring = shortened.maxother = _LONG
    return shortened.repr(value)


def _cut(text: str, most: int = 80) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."


def _did_you_mean(at: Loc, model: type[BaseModel]) -> str:
    block = _model_at(at[:-1], model)
    close = difflib.get_close_matches(str(at[-1])[:_LONG], list(block.model_fields), 1, 0.6)
    if close:
        return f", did you mean '{close[0]}'?"
    elsewhere = [place for place in places(model) if place[-1] == at[-1]]
    if elsewhere:
        return f", did you mean '{'.'.join(map(str, elsewhere[0]))}'?"
    return f"; known are {', '.join(block.model_fields)}"


def _model_at(at: Loc, model: type[BaseModel]) -> type[BaseModel]:
    for step in at:
        if isinstance(step, int):  # an item of a list of sections
            continue
        inner = section(model.model_fields[step].annotation) if step in model.model_fields else None
        if inner is None:
            return model
        model = inner
    return model


def section(annotation: Any) -> type[BaseModel] | None:
    """The section that a field's type is (or may be), if any."""
    for option in (annotation, *typing.get_args(annotation)):
        if isinstance(option, type) and issubclass(option, BaseModel):
            return option
    return None


def places(model: type[BaseModel] = Job, at: Loc = ()) -> list[Loc]:
    """Every key of a job, from the top: ("seed",), ("render",), ("render", "spp"), ... but not in lists."""
    found: list[Loc] = []
    for name, field in model.model_fields.items():
        found.append((*at, name))
        inner = section(field.annotation)
        if inner is not None and typing.get_origin(field.annotation) is not tuple:
            found += places(inner, (*at, name))
    return found
