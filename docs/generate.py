"""Writes the pages that say what the code says: `python docs/generate.py`, which `make docs` runs.

Job keys and meta.yaml come from their schemas, fields from the field table, commands from the command lines'
own help. A test fails when a page says something else.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import typer
from pydantic import BaseModel

from bench.recording.meta import Meta
from synth.dataset import field_sizes
from synth.job import reader, writer
from synth.job.schema import Job

DOCS = Path(__file__).resolve().parent
PROGRAMS = ("synth", "learn", "bench")
_WRITTEN = "Written by `make docs`; do not edit."


@dataclass(frozen=True)
class Spoken:
    """One command as a person types it."""

    words: tuple[str, ...]
    """("bench", "pareto", "flow")."""
    command: Any
    """The click command behind it; `Any`, as newer typer releases carry their own copy of click."""

    @property
    def group(self) -> bool:
        """Whether it does nothing itself."""
        return hasattr(self.command, "list_commands")

    @property
    def examples(self) -> list[str]:
        """What its help says after each `Example:`."""
        lines = (self.command.epilog or "").splitlines()
        return [line.partition("Example:")[2].strip() for line in lines if "Example:" in line]


def commands() -> Iterator[Spoken]:
    """Every command of the three programs, each group before its own."""
    for name in PROGRAMS:
        yield from _below(typer.main.get_command(import_module(f"{name}.cli").app), (name,))


def pages() -> dict[Path, str]:
    """The generated pages and what they must hold."""
    return {
        DOCS / "fields.md": field_sizes.page(),
        DOCS / "reference" / "job.md": _job(),
        DOCS / "reference" / "recording.md": _recording(),
        DOCS / "reference" / "commands.md": _commands(),
    }


def _below(command: Any, words: tuple[str, ...]) -> Iterator[Spoken]:
    spoken = Spoken(words, command)
    yield spoken
    if spoken.group:
        context = command.make_context(words[-1], [], resilient_parsing=True)
        for name in command.list_commands(context):
            yield from _below(command.get_command(context, name), (*words, name))


def _job() -> str:
    head = [
        "# The job file",
        "",
        f"{_WRITTEN} `synth new job.yaml` writes the same as a file to edit; `synth schema` gives the",
        "JSON schema for editors. Every key may be left out; on the command line it is `section.key=value`.",
        "A range is `[low, high]`, drawn anew for each sequence; one number is a range that holds only it.",
    ]
    return "\n".join([*head, *_keys(Job(), "")]) + "\n"


def _recording() -> str:
    head = [
        "# A recording's meta.yaml",
        "",
        f"{_WRITTEN} What else a recording folder holds: [Your own recording](../howto/recording.md).",
    ]
    return "\n".join([*head, *_keys(Meta.model_construct(), "")]) + "\n"


def _keys(section: BaseModel, at: str) -> list[str]:
    """A table of a section's keys, then its sections' own."""
    rows: list[str] = []
    inner: list[str] = []
    for name, field in type(section).model_fields.items():
        default = field.get_default(call_default_factory=True)
        below = reader.section(field.annotation)
        if isinstance(default, BaseModel):
            inner += ["", f"## {at}{name}", "", _sentence(type(default).__doc__)]
            inner += _keys(default, f"{at}{name}.")
            continue
        meaning = _sentence(field.description or (below.__doc__ if below else ""))
        limits = writer.limits(field.annotation, field.metadata)
        if limits:
            meaning += f" {limits}"
        value = "" if field.is_required() else writer.scalar(default)
        shown = "needed" if field.is_required() else f"`{value}`" if value else "–"
        rows.append(f"| `{name}` | {shown} | {_cell(meaning)} |")
        if below is not None:
            many = "tuple" in str(field.annotation)
            inner += ["", f"## {at}{name}{', each of them' if many else ''}", "", _sentence(below.__doc__)]
            inner += _keys(below.model_construct(), "" if many else f"{at}{name}.")
    table = ["", "| key | default | meaning |", "| --- | --- | --- |", *rows] if rows else []
    return [*table, *inner]


def _sentence(text: str | None) -> str:
    return " ".join((text or "").split())


def _cell(text: str) -> str:
    return _sentence(text).replace("|", r"\|")


def _commands() -> str:
    lines = ["# Commands", "", f"{_WRITTEN} Every command has `--help`."]
    for spoken in commands():
        name = " ".join(spoken.words)
        lines += ["", f"{'##' if spoken.group else '###'} {name}", "", _sentence(spoken.command.help)]
        if spoken.group:
            continue
        for line in spoken.examples:
            lines += ["", f"    {line}"]
        rows = [_parameter(one) for one in spoken.command.params if one.name != "help"]
        if rows:
            lines += ["", "| parameter | default | meaning |", "| --- | --- | --- |", *rows]
    return "\n".join(lines) + "\n"


def _parameter(one: Any) -> str:
    option = one.param_type_name == "option"
    names = [*one.opts, *one.secondary_opts] if option else [one.name.upper()]
    default = one.default() if callable(one.default) else one.default
    if isinstance(default, (list, tuple)):
        default = " ".join(str(part) for part in default)
    if one.required:
        shown = "needed"
    elif default in (None, "", False) or getattr(one, "is_flag", False):
        shown = "–"
    else:
        shown = f"`{getattr(default, 'value', default)}`"
    return f"| {', '.join(f'`{name}`' for name in names)} | {shown} | {_cell(one.help)} |"


if __name__ == "__main__":
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        if not path.exists() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")
            print(f"wrote {path.relative_to(DOCS.parent)}")
