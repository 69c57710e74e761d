"""Where each room hangs its measuring commands: `bench pareto X`, `bench stability X` and so on.

A room has a folder here; a file in it holds one plain function whose arguments are typer's, with one line in
`COMMANDS`. The module is imported only when its command (or its group's help) is asked for, so that
`bench --help` doesn't load Mitsuba and torch.
"""

from __future__ import annotations

import json as json_
import shlex
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from synth.errors import UserError

Json = Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")]


@dataclass(frozen=True)
class Command:
    """One room's measuring command."""

    group: str
    """`pareto` (speed against accuracy), `stability` (where it breaks) or `experiment` (a question)."""
    name: str
    """The word after the group."""
    module: str
    """Module that holds it."""
    function: str
    """Function in that module; its docstring's first line is the help."""
    example: str
    """What follows the names in the example of its help."""


COMMANDS: tuple[Command, ...] = (
    Command("experiment", "flow", "evidence.flow.experiment", "experiment", "--out runs/flow --only warped"),
    Command(
        "stability", "flow", "evidence.flow.stability", "stability", "--out runs/flow --methods tvl1,dis"
    ),
    Command("pareto", "flow", "evidence.flow.pareto", "pareto", "--out runs/flow --count 2"),
    Command("experiment", "realism", "evidence.render.realism", "realism_figures", "cortex.jpg"),
    Command("experiment", "render", "evidence.render.cost", "experiment", "cost frames"),
    Command("stability", "render", "evidence.render.stability", "stability", "--out runs/render"),
    Command("pareto", "render", "evidence.render.pareto", "pareto", "--spp 2 --spp 8 --out runs/render"),
    Command("experiment", "camera-noise", "evidence.render.camera_noise", "camera_noise", "flats darks"),
    Command("experiment", "cycles", "evidence.render.cycles", "cycles", "--python bpy/bin/python"),
    Command("experiment", "throughput", "evidence.render.throughput", "throughput", "--spp 4 --out runs/gpu"),
    Command("experiment", "gpu", "evidence.gpu", "gpu", "--out runs/gpu"),
    Command("experiment", "stages", "evidence.engine.stage_costs", "stages", "out --out runs/stages"),
    Command("experiment", "leakage", "evidence.gap.leakage", "leakage", "out --out runs/leakage"),
    Command("experiment", "scoring", "evidence.scoring.scoring_cost", "cost", "model --train out"),
    Command("experiment", "inverse", "evidence.scoring.inverse", "experiment", "--count 10"),
    Command(
        "experiment", "learn", "evidence.learn.experiment", "experiment", "--cache cache --out runs/learn"
    ),
    Command("stability", "learn", "evidence.learn.stability", "stability", "--cache cache --seeds 2"),
    Command("experiment", "loading", "evidence.learn.throughput", "loading", "--steps 3 --out runs/loading"),
    Command("experiment", "full-size", "evidence.learn.full_size", "full_size", "--cache cache --out full"),
    Command("pareto", "learn", "evidence.learn.pareto", "pareto", "--out runs/learn --repeats 10"),
    Command("experiment", "tune", "evidence.tune.experiment", "experiment", "--only easy --fresh 3"),
    Command(
        "pareto",
        "end-to-end",
        "evidence.end_to_end.pareto",
        "pareto",
        "--fit 8 --test 6 --out runs/end-to-end",
    ),
    Command("pareto", "all", "evidence.overview", "pareto", "--out runs/all"),
    Command("stability", "all", "evidence.overview", "stability", "--out runs/all"),
    Command("pareto", "fem", "evidence.fem.pareto", "pareto", "--load 0.3 --out runs/fem"),
    Command("stability", "fem", "evidence.fem.stability", "stability", "--scenes 100 --out runs/fem"),
    Command(
        "experiment", "surface", "evidence.fem.surface", "surface", "brain.obj --direction=-0.4,0.8,0.45"
    ),
    Command("experiment", "relief", "evidence.fem.relief", "relief", "--scenes 4 --tets 800,1600,5000"),
    Command("experiment", "slides", "evidence.fem.slides", "slides", "--scenes 10"),
    Command("experiment", "half-space", "evidence.fem.half_space", "half_space", "--tets 800,1600"),
    Command("stability", "damage", "evidence.engine.damage", "damage", "out --count 50 --out runs/damage"),
    Command(
        "experiment", "scale", "evidence.engine.large_index", "scale", "--sequences 10000 --out runs/scale"
    ),
    Command("stability", "dask", "evidence.engine.dask", "dask", "--workers 2 --out runs/dask"),
    Command("stability", "trouble", "evidence.engine.trouble", "trouble", "--sequences 6 --out runs/trouble"),
    Command("pareto", "engine", "evidence.engine.speed", "speed", "--rendered 4 --out runs/speed"),
    Command("pareto", "reading", "evidence.engine.reading", "reading", "out --count 50 --out runs/reading"),
    Command(
        "experiment", "cost", "evidence.engine.cost", "cost", "out --frames 1000000 --page docs/scaling.md"
    ),
    Command("stability", "faults", "evidence.engine.faults", "faults", "--full tiny --read-only ro"),
    Command("stability", "kills", "evidence.engine.kills", "kills", "--count 20 --out runs/kills"),
)


class Rooms(TyperGroup):
    """A group whose commands are those of `COMMANDS` with the group's name.

    Typed `Any` where click's classes would stand: newer typer releases carry their own copy of click.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        return [entry.name for entry in COMMANDS if entry.group == self.name]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        for entry in COMMANDS:
            if entry.group == self.name and entry.name == cmd_name:
                return load(entry)
        return None


def load(entry: Command) -> Any:
    """The command behind an entry, its module imported.

    Raises:
        ImportError, AttributeError: the entry names what isn't there (a test loads every entry).
    """
    single = typer.Typer(add_completion=False)
    single.command(entry.name, epilog=f"Example: bench {entry.group} {entry.name} {entry.example}")(
        getattr(import_module(entry.module), entry.function)
    )
    return typer.main.get_command(single)


def add_to(app: typer.Typer) -> None:
    """Hangs all of them into `bench`."""
    for name, said in (
        ("pareto", "Speed against accuracy of one room's choices."),
        ("stability", "Where one room's methods break, and that they say so."),
        ("experiment", "One stated question about one room, answered with numbers."),
    ):
        app.add_typer(typer.Typer(name=name, cls=Rooms, help=said, no_args_is_help=True))
    app.command(epilog="Example: bench pages docs/results --check")(pages)
    app.command("make-exvivo", epilog="Example: bench make-exvivo --out recordings --count 2 --seconds 10")(
        make_exvivo
    )
    app.command(epilog="Example: bench gap out --cache cache --out runs/gap --held-out calf")(gap)


def pages(
    results: Annotated[Path, typer.Argument(help="Folder of results.")] = Path("docs/results"),
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; end with 1 if any is stale.")
    ] = False,
    json: Json = False,
) -> None:
    """Draws picture and page of every experiment anew from its data, where its own command doesn't."""
    from evidence import catalogue as drawn

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
    json: Json = False,
) -> None:
    """Renders pseudo ex vivo recordings, unlike any training data in every respect at once."""
    from bench.output.progress_bar import counting
    from evidence.scoring import exvivo

    plan = exvivo.Plan(seed, seconds, fps, (width, width * 3 // 4), photo.resolve() if photo else None)
    written = []
    for index in range(first, first + count):
        with counting(f"recording {index}", int(seconds * fps)) as progress:
            done = exvivo.make(plan, index, out / f"{index:03d}", progress)
        written.append(str(done))
    print(json_.dumps({"recordings": written}) if json else "\n".join(written))


def gap(
    dataset: Annotated[Path, typer.Argument(help="Dataset rendered in several appearance families.")],
    cache: Annotated[Path, typer.Option(help="Folder for packed sequences and trained networks.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path(
        "docs/results/gap"
    ),
    held_out: Annotated[str, typer.Option(help="Appearance family that no training sees.")] = "calf",
    flow: Annotated[
        list[str] | None,
        typer.Option(help="Back end of the recovered flow; each is a whole experiment. [default: both]"),
    ] = None,
    preset: Annotated[str, typer.Option(help="Preset of `learn train`.")] = "tiny",
    epochs: Annotated[int | None, typer.Option(min=1, help="Epochs; the preset's if not given.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Networks a training.")] = 2,
    json: Json = False,
) -> None:
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
        shlex.join(["bench", *sys.argv[1:]]),
        lambda line: Console(stderr=True).print(line, markup=False),
    )
    if json:
        print(json_.dumps({name: found["verdict"] for name, found in tree["flows"].items()}))
    else:
        for name, found in tree["flows"].items():
            print(f"{name}: {found['verdict']['force_mae']}")
        print(out / "README.md")
