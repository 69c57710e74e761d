"""Where each room hangs its measuring commands: `bench pareto X`, `bench stability X` and so on.

A room has a folder here; a function in it that `evidence.measuring` declares has one line in `COMMANDS`. Its
module is imported only when its command (or its group's help) is asked for, so that `bench --help` doesn't
load Mitsuba and torch.
"""

from __future__ import annotations

import json as json_
import shlex
import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from evidence.measuring import Json, hang_into, measuring, name_only
from synth.errors import UserError

COMMANDS = {
    "experiment flow": "evidence.flow.experiment:experiment",
    "experiment stereo": "evidence.flow.stereo:experiment",
    "experiment second-eye": "evidence.end_to_end.second_eye:experiment",
    "stability flow": "evidence.flow.stability:stability",
    "stability stereo": "evidence.flow.stereo_stability:stability",
    "stability recordings": "evidence.flow.foreign:recordings",
    "pareto flow": "evidence.flow.pareto:pareto",
    "experiment look-flow": "evidence.flow.look:look",
    "experiment gallery": "evidence.render.gallery:gallery",
    "experiment realism": "evidence.render.realism:realism_figures",
    "experiment texture": "evidence.look.texture:texture",
    "experiment classifier": "evidence.look.classifier:classifier",
    "experiment fit": "evidence.look.fit:fit",
    "experiment render": "evidence.render.cost:experiment",
    "stability render": "evidence.render.stability:stability",
    "pareto render": "evidence.render.pareto:pareto",
    "experiment camera-noise": "evidence.render.camera_noise:camera_noise",
    "experiment cycles": "evidence.render.cycles:cycles",
    "experiment throughput": "evidence.render.throughput:throughput",
    "experiment gpu": "evidence.gpu:gpu",
    "experiment stages": "evidence.engine.stage_costs:stages",
    "experiment leakage": "evidence.gap.leakage:leakage",
    "experiment scoring": "evidence.scoring.scoring_cost:cost",
    "experiment inverse": "evidence.scoring.inverse:experiment",
    "experiment pulse": "evidence.scoring.pulse:experiment",
    "experiment learn": "evidence.learn.experiment:experiment",
    "stability learn": "evidence.learn.stability:stability",
    "experiment loading": "evidence.learn.throughput:loading",
    "experiment full-size": "evidence.learn.full_size:full_size",
    "experiment foreign": "evidence.foreign.recordings:foreign",
    "experiment curves": "evidence.curves.experiment:experiment",
    "experiment shipped": "evidence.learn.shipped:experiment",
    "pareto learn": "evidence.learn.pareto:pareto",
    "experiment tune": "evidence.tune.experiment:experiment",
    "pareto end-to-end": "evidence.end_to_end.pareto:pareto",
    "pareto all": "evidence.overview:pareto",
    "stability all": "evidence.overview:stability",
    "pareto fem": "evidence.fem.pareto:pareto",
    "stability fem": "evidence.fem.stability:stability",
    "experiment surface": "evidence.fem.surface:surface",
    "experiment relief": "evidence.fem.relief:relief",
    "experiment slides": "evidence.fem.slides:slides",
    "experiment half-space": "evidence.fem.half_space:half_space",
    "experiment contact": "evidence.fem.contact:rigid",
    "experiment mechanics": "evidence.mechanics.experiment:experiment",
    "stability damage": "evidence.engine.damage:damage",
    "experiment scale": "evidence.engine.large_index:scale",
    "stability dask": "evidence.engine.dask:dask",
    "stability trouble": "evidence.engine.trouble:trouble",
    "pareto engine": "evidence.engine.speed:speed",
    "pareto reading": "evidence.engine.reading:reading",
    "experiment cost": "evidence.engine.cost:cost",
    "stability faults": "evidence.engine.faults:faults",
    "stability kills": "evidence.engine.kills:kills",
}
"""Words after `bench`, and the function behind them as module:function.

Groups: `pareto` (speed against accuracy), `stability` (where it breaks), `experiment` (a question).
"""


class Rooms(TyperGroup):
    """A group whose commands are those of `COMMANDS` with the group's name.

    Typed `Any` where click's classes would stand: newer typer releases carry their own copy of click.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        return [words.split()[1] for words in COMMANDS if words.split()[0] == self.name]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        words = f"{self.name} {cmd_name}"
        return load_command(words) if words in COMMANDS else None


def load_command(words: str) -> Any:
    """The command behind an entry, its module imported.

    Raises:
        ImportError, AttributeError, KeyError: the entry names what isn't there, or isn't declared (a test
            loads every entry).
    """
    module, _, function = COMMANDS[words].partition(":")
    single = typer.Typer(add_completion=False, rich_markup_mode=None)
    hang_into(single, getattr(import_module(module), function), words)
    return typer.main.get_command(single)


def add_to(app: typer.Typer) -> None:
    """Hangs all of them into `bench`."""
    for name, said in (
        ("pareto", "Speed against accuracy of one room's choices."),
        ("stability", "Where one room's methods break, and that they say so."),
        ("experiment", "One stated question about one room, answered with numbers."),
    ):
        app.add_typer(typer.Typer(name=name, cls=Rooms, help=said, no_args_is_help=True))
    hang_into(app, pages, "pages")
    app.command("make-exvivo", epilog="Example: bench make-exvivo --out recordings --count 2 --seconds 10")(
        make_exvivo
    )
    hang_into(app, gap, "gap")


@measuring("docs/results --check")
def pages(
    results: Annotated[Path, typer.Argument(help="Folder of results.")] = Path("docs/results"),
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; end with 1 if any is stale.")
    ] = False,
    json: Json = False,
) -> None:
    """Draws picture and page of every experiment anew from its data."""
    from evidence import pages as drawn

    if not results.is_dir():
        raise UserError(f"{results}: no such folder")
    found = drawn.stale(results) if check else drawn.write(results)
    print(
        json_.dumps([str(file) for file in found])
        if json
        else "\n".join(map(str, found)) or "all as they should be"
    )
    if check and found:
        raise typer.Exit(1)


def make_exvivo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder that gets the recordings.")],
    count: Annotated[int, typer.Option(min=1, help="How many recordings.")] = 6,
    first: Annotated[
        int, typer.Option(min=0, help="Number of the first; they don't depend on each other.")
    ] = 0,
    seconds: Annotated[float, typer.Option(help="Length of each.")] = 30.0,
    fps: Annotated[float, typer.Option(min=1.0, help="Mean frames a second.")] = 10.0,
    width: Annotated[int, typer.Option(min=64, help="Width of the picture; the height is 3/4 of it.")] = 320,
    photo: Annotated[Path | None, typer.Option(help="A photograph as texture of the surface.")] = None,
    seed: Annotated[int, typer.Option(help="Root of all draws.")] = 100,
    eyes: Annotated[int, typer.Option(min=1, max=2, help="Cameras that look on.")] = 1,
    json: Json = False,
) -> None:
    """Renders pseudo ex vivo recordings, unlike any training data in every respect at once."""
    from bench.output.progress_bar import counting
    from evidence.scoring import exvivo

    plan = exvivo.Plan(
        seed, seconds, fps, (width, width * 3 // 4), photo.resolve() if photo else None, eyes=eyes
    )
    written = []
    for index in range(first, first + count):
        with counting(f"recording {index}", int(seconds * fps)) as progress:
            done = exvivo.make(plan, index, out / f"{index:03d}", progress)
        written.append(str(done))
    print(json_.dumps({"recordings": written}) if json else "\n".join(written))


@measuring(
    "out --cache cache --out runs/gap --held-out calf",
    out="docs/results/gap",
    said="Folder for the results.",
    text=lambda found: "\n".join(f"{name}: {verdict['force_mae']}" for name, verdict in found.items()),
)
def gap(
    dataset: Annotated[Path, typer.Argument(help="Dataset rendered in several appearance families.")],
    cache: Annotated[Path, typer.Option(help="Folder for packed sequences and trained networks.")],
    out: Path,
    held_out: Annotated[str, typer.Option(help="Appearance family that no training sees.")] = "calf",
    unseen: Annotated[
        Path | None, typer.Option(help="Dataset that no training sees; it takes the held-out family's place.")
    ] = None,
    fit: Annotated[int | None, typer.Option(min=20, help="Take so many sequences of `dataset` only.")] = None,
    flow: Annotated[
        list[str] | None,
        typer.Option(help="Back end of the recovered flow; each is a whole experiment. [default: both]"),
    ] = None,
    preset: Annotated[str, typer.Option(help="Preset of `learn train`.")] = "tiny",
    epochs: Annotated[int | None, typer.Option(min=1, help="Epochs; the preset's if not given.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Networks a training.")] = 2,
) -> dict[str, Any]:
    """How much of the sim-to-real gap training on recovered flow closes, and fitted noise alone."""
    from rich.console import Console

    from evidence.gap import experiment
    from learn.training.threads import set_threads

    set_threads(1)
    tree = experiment.run(
        dataset,
        out,
        cache,
        experiment.settings_of(preset, epochs),
        held_out,
        flow or ["tvl1", "opencv-tvl1"],
        seeds,
        shlex.join(["bench", *map(name_only, sys.argv[1:])]),
        lambda line: Console(stderr=True).print(line, markup=False),
        unseen,
        fit,
    )
    return {name: found["verdict"] for name, found in tree["flows"].items()}
