"""`bench pareto all`, `bench stability all`: every room's results on one page each."""

from __future__ import annotations

import html
import json as json_
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.output import plot
from bench.output import write as kept
from evidence import defaults_on_front
from evidence.measuring import measuring
from synth.errors import UserError

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
    parts = [
        "<p>Each default of the code among the points measured for it, none dearer than it needs to be: off "
        "the front is by how much it costs more than the cheapest point that errs no more, or errs more than "
        f"the best that costs no more, whichever is less; "
        f"{100 * defaults_on_front.ALLOWED:.0f}% are allowed. "
        "Where errors have intervals (end to end) another rule decides: a default is off the front when a "
        "point that costs no more errs less beyond the interval of their paired difference, and by more than "
        f"{100 * defaults_on_front.ALLOWED:.0f}%. Rings mark defaults.</p>",
        plot.table(rows),
        plot.charts(list(_pareto_panels(results))),
        *_credits([results / name for name in PARETO]),
    ]
    folder = out or results / "all" / "pareto"
    plot.write_page(folder, "Error against cost, every room", parts)
    kept.keep(folder, "fronts.json", rows)
    if json:
        print(json_.dumps(rows))
    else:
        for row in rows:
            print(f"{row['room']:34s} {row['default']:44s} {row['off the front']} off the front")
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
    from evidence.fem import stability as fem_stability
    from evidence.flow import stability as flow_stability

    fem, flow, render = (defaults_on_front.read(results / name) for name in STABILITY)
    parts = [
        "<h2>Physics</h2>",
        plot.charts(fem_stability.panels(fem)),
        "<h2>Flow</h2>",
        plot.charts(flow_stability.panels(flow)),
        "<h2>Rendering: a correct frame or a clear error</h2>",
        plot.table(render["cases"]),
    ]
    for file in sorted(results.glob("learn/stability/*.json")):
        found = defaults_on_front.read(file)
        if found.get("rows"):
            parts += [f"<h2>Learning: {html.escape(file.stem)}</h2>", plot.table(found["rows"])]
    engine = [
        {"trial": file.parent.name} | {key: value for key, value in _flat(defaults_on_front.read(file))}
        for file in sorted(results.glob("engine/*/*.json"))
        if file.parent.name in ("damage", "dask", "faults", "kills", "kills-real", "trouble")
    ]
    parts.append("<h2>Engine</h2>")
    parts += [plot.table([row]) for row in engine]
    parts += _credits([results / name for name in STABILITY])
    folder = out or results / "all" / "stability"
    plot.write_page(folder, "Where it breaks, every room", parts)
    held = {
        "render cases": len(render["cases"]),
        "render cases that held": sum(bool(case["passed"]) for case in render["cases"]),
        "engine trials": len(engine),
    }
    print(json_.dumps(held) if json else folder / "index.html")


def _pareto_panels(results: Path) -> Iterator[plot.Panel]:
    from evidence.end_to_end import page
    from evidence.fem import pareto as fem_pareto
    from evidence.flow import pareto as flow_pareto
    from evidence.learn import pareto as learn_pareto
    from evidence.learn import preset_errors
    from evidence.render import pareto as render_pareto

    yield from page.panels(defaults_on_front.read(results / "end-to-end/pareto.json"))
    yield from fem_pareto.panels(defaults_on_front.read(results / "fem/pareto/pareto.json"))
    yield from render_pareto.panels(defaults_on_front.read(results / "render/pareto/pareto.json"))
    yield from flow_pareto.panels(defaults_on_front.read(results / "flow/pareto/pareto.json"))
    rows = learn_pareto.with_errors(
        defaults_on_front.read(results / "learn/pareto/data-cpu.json")["rows"],
        preset_errors.errors(results / "learn"),
    )
    yield from learn_pareto.chart(rows, "cpu")


def _credits(files: list[Path]) -> list[str]:
    """Command and machine of each file."""
    return [plot.credit(defaults_on_front.read(file)) for file in files]


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
