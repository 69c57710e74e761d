"""What every measuring command shares: `--out`, `--json`, the data with command and machine, what is printed.

A command is a plain function whose arguments are typer's; it measures and gives its data back. `measuring`
above it says the rest, and leaves the function as it is, to be called by tests.
"""

from __future__ import annotations

import inspect
import json
import math
import re
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import EllipsisType
from typing import Annotated, Any, TypeVar, get_origin

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bench.output import machine, write
from synth.system.text_lines import hang

CHECKOUT = Path(__file__).resolve().parents[1]
"""Where the code is; a default folder below `docs/results` is one of its own, wherever a command is given."""

Json = Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")]
Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(frozen=True)
class Declared:
    """What `measuring` was told."""

    example: str
    out: str | EllipsisType | None
    said: str
    file: str | None
    page: Callable[[Any, Path], object] | None
    text: str | Callable[[Any], str]
    passed: Callable[[Any], bool] | None


DECLARED: dict[Callable[..., Any], Declared] = {}
"""Of every function that a module imported so far declares."""


def measuring(
    example: str,
    *,
    out: str | EllipsisType | None = None,
    said: str = "Folder of the results.",
    file: str | None = None,
    page: Callable[[Any, Path], object] | None = None,
    text: str | Callable[[Any], str] = "",
    passed: Callable[[Any], bool] | None = None,
) -> Callable[[Function], Function]:
    """Declares a measuring command.

    The function may have a plain parameter `out` or `json`, if it writes or prints in between; one that has
    typer's own annotation stays as it is. What is declared as giving None back says everything itself.

    Args:
        example: what follows the command's words in the example of its help.
        out: default of `--out`; None: nothing is written unless asked for; ...: has to be given.
        said: help of `--out`.
        file: that the data go into, `{name}` standing for a value of the command; None: the function writes
            its own, with `out`.
        page: writes what else is made from the data, a page or a picture, into the folder.
        text: the data as a person reads them; or the file of the folder that is named instead. Empty: every
            list of rows as a table, and what else there is line by line.
        passed: whether the exit code is 0.
    """

    def declare(function: Function) -> Function:
        DECLARED[function] = Declared(example, out, said, file, page, text, passed)
        return function

    return declare


def hang_into(app: typer.Typer, function: Callable[..., Any], words: str) -> None:
    """Adds the command of a declared function.

    Args:
        app: or group, that gets it.
        function: as `measuring` got it.
        words: what is typed after `bench`: "pareto fem".
    """
    epilog = f"Example: bench {words} {DECLARED[function].example}"
    app.command(words.split()[-1], epilog=epilog)(_with_shared_options(function, words))


def _with_shared_options(function: Callable[..., Any], words: str) -> Callable[..., None]:
    """What typer is to call: it calls the function, keeps what comes back and says it."""
    declared = DECLARED[function]
    signature = inspect.signature(function, eval_str=True)
    own = signature.parameters

    def command(ctx: typer.Context, **given: Any) -> None:
        values = {name: _in_checkout(ctx, name, value) for name, value in given.items()}
        found = function(**{name: value for name, value in values.items() if name in own})
        if found is None:
            return
        if declared.file is not None:
            found = shortened({"command": _typed(ctx, words), "machine": machine.describe()} | found)
        folder = values.get("out")
        if folder is not None:
            if declared.file is not None:
                write.keep(folder, _named(declared.file, values), found)
            if declared.page is not None:
                declared.page(found, folder)
        _say(found, declared.text, folder, values["json"])
        if declared.passed is not None and not declared.passed(found):
            raise typer.Exit(1)

    parameters = {name: one for name, one in own.items() if not _plain(one)}
    silent = signature.return_annotation is not None
    if declared.file or "out" in own:
        parameters.setdefault("out", _out_option(declared))
    if silent or "json" in own:
        parameters.setdefault("json", _json_option())
    context = inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    keyword = [one.replace(kind=one.KEYWORD_ONLY) for one in parameters.values()]
    command.__signature__ = inspect.Signature([context, *keyword])  # type: ignore[attr-defined]
    command.__annotations__ = {one.name: one.annotation for one in (context, *keyword)}
    command.__doc__ = function.__doc__
    return command


def shortened(value: Any) -> Any:
    """A tree with its floats to six digits: what is behind them is noise, and takes half of a file."""
    if isinstance(value, Mapping):
        return {key: shortened(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [shortened(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def four_digits(value: float, bits: int = 13) -> float:
    """The nearest number of so many bits: those that follow can't be packed, and say nothing."""
    part, power = math.frexp(value)
    return math.ldexp(round(part * 2**bits), power - bits) if math.isfinite(value) else value


def _named(file: str, values: dict[str, Any]) -> str:
    """The file's name with the command's values in it, of a path its stem."""
    words = {name: value.stem if isinstance(value, Path) else value for name, value in values.items()}
    return file.format(**words)


def _plain(one: inspect.Parameter) -> bool:
    """Whether the shared option takes this parameter's place."""
    return one.name in ("out", "json") and get_origin(one.annotation) is not Annotated


def _out_option(declared: Declared) -> inspect.Parameter:
    kind: Any = Path | None if declared.out is None else Path
    default: Any = inspect.Parameter.empty if declared.out is ... else declared.out and Path(declared.out)
    option = Annotated[kind, typer.Option("--out", "-o", help=declared.said)]
    return inspect.Parameter("out", inspect.Parameter.KEYWORD_ONLY, default=default, annotation=option)


def _json_option() -> inspect.Parameter:
    return inspect.Parameter("json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Json)


def _in_checkout(ctx: typer.Context, name: str, value: Any) -> Any:
    """A default folder of results is the checkout's; one that was typed is the caller's."""
    default = isinstance(value, Path) and value.is_relative_to("docs/results")
    source = ctx.get_parameter_source(name) if default else None
    return CHECKOUT / value if source is not None and source.name == "DEFAULT" else value


def _typed(ctx: typer.Context, words: str) -> str:
    """The command with every setting, folders left out: a path's name, also behind `NAME=`; `--out` and
    `--json` not at all."""
    typed = ["bench", *words.split()]
    for one in ctx.command.params:
        value = ctx.params.get(str(one.name))
        if one.name in ("out", "json", "help") or value is None or value is False:
            continue
        for part in value if isinstance(value, (list, tuple)) else [value]:
            said = part.name if isinstance(part, Path) else str(part)
            said = name_only(said) if "=" in said else said
            if one.param_type_name == "argument":
                typed.append(said)
            elif part is True:
                typed.append(one.opts[0])
            else:
                typed += [f"{one.opts[0]}={said}"] if said.startswith("-") else [one.opts[0], said]
    return shlex.join(typed)


_FOLDERS = re.compile(r"^([^/=]+=|)/?(?:[^/]+/)*([^/]+)/*$")
"""Of `NAME=PATH` or a path: the name, and the path's last part."""


def name_only(word: str) -> str:
    """A word of a command line with its path, also one behind `NAME=`, cut down to the last part."""
    return _FOLDERS.sub(r"\1\2", word)


def _say(found: Any, text: str | Callable[[Any], str], folder: Path | None, as_json: bool) -> None:
    if as_json:
        print(json.dumps(found))
    elif callable(text):
        print(text(found))
    elif text and folder is not None:
        print(folder / text)
    else:
        _show(found)


def _show(found: Any) -> None:
    """Data for a person: rows as tables, all else line by line."""
    console = Console(width=None if sys.stdout.isatty() else 140)
    for name, value in found.items() if isinstance(found, dict) else [("", found)]:
        if isinstance(value, dict) and all(isinstance(row, dict) for row in value.values()):
            value = [{name: key, **row} for key, row in value.items()]
        if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
            columns = list(dict.fromkeys(key for row in value for key in row))
            table = Table(*map(escape, columns), title=escape(name), title_justify="left")
            for row in value:
                table.add_row(*(_cell(row.get(key)) for key in columns))
            if (
                console.measure(table, options=console.options.update(max_width=10_000)).maximum
                <= console.width
            ):
                console.print(table)
                continue
            # Too wide: row by row, rather than cut off.
            console.print(name, markup=False, highlight=False)
            for row in value:
                told = ", ".join(f"{key} {_cell(row[key])}" for key in columns if key in row)
                console.print("\n".join(hang("  ", told, console.width)), markup=False, highlight=False)
        elif name not in ("command", "machine", "meaning"):
            console.print(f"{name}: {_cell(value)}", markup=False, highlight=False)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else escape(str(value))
