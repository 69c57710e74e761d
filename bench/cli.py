"""The `bench` command. Heavy imports are inside the commands, so that `bench --help` answers at once."""

from __future__ import annotations

import json as json_
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.rooms import Rooms
from synth.commands import Commands

if TYPE_CHECKING:
    from bench.assess import Result

app = typer.Typer(
    name="bench",
    cls=Commands,
    help="Measures: recordings against force sensors, methods against one another.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

for _name, _help in (
    ("pareto", "Speed against accuracy of one room's choices."),
    ("stability", "Where one room's methods break, and that they say so."),
    ("experiment", "One stated question about one room, answered with numbers."),
):
    app.add_typer(typer.Typer(name=_name, cls=Rooms, help=_help, no_args_is_help=True))

Json = Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")]


class Footage(StrEnum):
    """How exported frames are kept."""

    png = "png"
    mp4 = "mp4"


@app.command()
def score(
    recording: Annotated[
        Path, typer.Argument(help="Recording folder: meta.yaml, video or frames, force.csv.")
    ],
    model: Annotated[Path, typer.Option("--model", "-m", help="Model folder of `learn train`.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for score.json and report.html; NAME-score.")
    ] = None,
    flow: Annotated[str, typer.Option(help="Flow estimator, as in a job's flow.backend.")] = "opencv-tvl1",
    shrink: Annotated[int, typer.Option(min=1, max=8, help="Flow on pictures this many times smaller.")] = 1,
    title: Annotated[str, typer.Option(help="Heading of the report.")] = "",
    json: Json = False,
) -> None:
    """Force from a recording's video, scored against its sensor: score.json and report.html."""
    from bench import run
    from bench.assess import Settings

    result = run.score(recording, model, out, Settings(backend=flow, shrink=shrink), title)
    _say(result, out or Path(f"{result.recording}-score"), json)


@app.command()
def demo(
    dataset: Annotated[Path, typer.Argument(help="A rendered dataset.")],
    model: Annotated[Path, typer.Option("--model", "-m", help="Model trained on it.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for recording, score and report.")],
    flow: Annotated[str, typer.Option(help="Flow estimator.")] = "opencv-tvl1",
    json: Json = False,
) -> None:
    """Scores a model on a sequence of its dataset that it has not seen, by way of a recording."""
    from bench import run
    from bench.assess import Settings

    _say(run.demo(dataset, model, out, Settings(backend=flow)), out, json)


@app.command("from-dataset")
def from_dataset(
    dataset: Annotated[Path, typer.Argument(help="A rendered dataset.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder that gets one recording a sequence.")],
    sequence: Annotated[int | None, typer.Option(help="Only this sequence.")] = None,
    footage: Annotated[Footage, typer.Option(help="Lossless pictures or H.264.")] = Footage.png,
    json: Json = False,
) -> None:
    """Writes sealed sequences as recording folders, to be scored as real ones are."""
    from bench.export import export
    from synth.errors import UserError
    from synth.store import Dataset

    chosen = [s for s in Dataset(dataset) if sequence is None or s.index == sequence]
    if not chosen:
        raise UserError(f"{dataset}: holds no finished sequence {sequence}")
    written = [export(s, out / f"{s.index:06d}", footage.value) for s in chosen]
    if json:
        print(json_.dumps({"recordings": [str(path) for path in written]}))
    else:
        for path in written:
            print(path)


def _say(result: Result, folder: Path, json: bool) -> None:
    from rich.console import Console

    from bench import assess, report

    if json:
        print(json_.dumps(assess.as_json(result), allow_nan=False))
        return
    console = Console()
    console.print(report.terminal_table(result))
    for note in result.notes:
        console.print(f"note: {note}", style="yellow", markup=False, highlight=False)
    console.print(f"report: {folder / 'report.html'}", markup=False, highlight=False)
