"""`bench pareto all`, `bench stability all`: every room's results on one page each."""

from __future__ import annotations

import json as json_
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.output import result_page
from bench.output import write as kept
from evidence import defaults_on_front
from evidence.measuring import measuring
from synth.errors import UserError
from synth.system.text_lines import hang

Out = Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the page; all/ in the results.")]
Results = Annotated[Path, typer.Option(help="Folder that holds the rooms' results.")]
Again = Annotated[
    bool, typer.Option("--run", help="Measure every room anew first, by the commands its data name.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")]

PARETO = (
    "fem/pareto/pareto.json",
    "render/pareto/pareto.json",
    "flow/pareto/pareto.json",
    "learn/pareto/data-cpu.json",
    "end-to-end/pareto.json",
)
STABILITY = (
    "fem/stability/stability.json",
    "flow/stability/stability.json",
    "render/stability/stability.json",
)
"""Of these, `--run` measures anew. Learning and engine need data of their own: by their own commands."""


def _bench(words: list[str]) -> int:
    return subprocess.run([sys.executable, "-m", "bench", *words], check=False).returncode


@measuring("--out runs/all")
def pareto(
    out: Out = None, results: Results = defaults_on_front.RESULTS, run: Again = False, json: Json = False
) -> None:
    """Error against cost in every room, and where defaults stand; ends with 1 if one left it."""
    if run:
        again([results / name for name in PARETO])
    gathered = defaults_on_front.gather(results)
    rows = defaults_on_front.table(gathered)
    folder = out or results / "all" / "pareto"
    words = (
        "Each default of the code among the points measured for it, none dearer than it needs to be: off "
        "the front is by how much it costs more than the cheapest point that errs no more, or errs more "
        f"than the best that costs no more, whichever is less; {100 * defaults_on_front.ALLOWED:.0f}% are "
        "allowed. Where errors have intervals (end to end) another rule decides: a default is off the "
        "front when a point that costs no more errs less beyond the interval of their paired difference, "
        f"and by more than {100 * defaults_on_front.ALLOWED:.0f}%. Rings mark defaults."
    )
    tables = [result_page.Section("Defaults", rows), _measured(results, PARETO)]
    links = _charts(results, PARETO, folder)
    page = result_page.Page("Error against cost, every room", {}, (), tables, (words,), links=links)
    result_page.write(page, folder)
    kept.keep(folder, "fronts.json", rows)
    if json:
        print(json_.dumps(rows))
    else:
        for row in rows:
            front = f"{row['off the front']:>6} off the front  {row['room']}: "
            print("\n".join(hang(front, str(row["default"]))))
        print(folder / "index.html")
    if not all(front.holds() for front in gathered):
        raise typer.Exit(1)


@measuring("--out runs/all")
def stability(
    out: Out = None, results: Results = defaults_on_front.RESULTS, run: Again = False, json: Json = False
) -> None:
    """Where everything breaks, room by room, on one page."""
    if run:
        again([results / name for name in STABILITY])
    cases = defaults_on_front.read(results / STABILITY[-1])["cases"]
    learning = [(file.stem, defaults_on_front.read(file)) for file in results.glob("learn/stability/*.json")]
    engine = [
        {"trial": file.parent.name} | dict(_flat(defaults_on_front.read(file)))
        for file in sorted(results.glob("engine/*/*.json"))
        if file.parent.name in ("damage", "dask", "faults", "kills", "kills-real", "trouble")
    ]
    sections = [
        result_page.Section("Rendering: a correct frame or a clear error", cases),
        *(result_page.Section(f"Learning: {name}", found["rows"]) for name, found in sorted(learning)),
        *(result_page.Section(f"Engine: {row['trial']}", [row]) for row in engine),
        _measured(results, STABILITY),
    ]
    folder = out or results / "all" / "stability"
    links = _charts(results, STABILITY[:-1], folder)
    page = result_page.Page("Where it breaks, every room", {}, (), sections, links=links)
    result_page.write(page, folder)
    held = {
        "render cases": len(cases),
        "render cases that held": sum(bool(case["passed"]) for case in cases),
        "engine trials": len(engine),
    }
    print(json_.dumps(held) if json else folder / "index.html")


def _charts(results: Path, files: Sequence[str], folder: Path) -> list[str]:
    """The rooms' own charts, as seen from `folder`."""
    return [os.path.relpath((results / file).with_name("chart.svg"), folder) for file in files]


def _measured(results: Path, files: Sequence[str]) -> result_page.Section:
    """Command and machine of each file."""
    found = {file: defaults_on_front.read(results / file) for file in files}
    rows = [
        {"data": file, "command": one.get("command"), **one.get("machine", {})} for file, one in found.items()
    ]
    return result_page.Section("Measured", rows)


def _flat(found: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """What fits into a cell; lists and machine left out."""
    for key, value in found.items():
        if key != "machine" and not isinstance(value, list):
            yield key, json_.dumps(value) if isinstance(value, dict) else value


def again(files: Sequence[Path], bench: Callable[[list[str]], int] = _bench) -> None:
    """Measures anew what files hold, by the command that each names, into its folder.

    Args:
        files: of results.
        bench: runs `bench` with these words; gives its exit status.

    Raises:
        UserError: a file names no command (before anything is measured), or a command failed.
    """
    commands = []
    for file in files:
        said = defaults_on_front.read(file).get("command")
        if said is None:
            raise UserError(f"{file}: names no command that measures it")
        commands.append(shlex.split(str(said))[1:])
    for file, words in zip(files, commands, strict=True):
        status = bench([*words, "--out", str(file.parent)])
        if status:
            raise UserError(f"bench {shlex.join(words)}: ended with {status}")
