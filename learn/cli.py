"""`learn train | eval | predict | calibrate | export | models`: from a dataset to a model, honest numbers,
forces and a file."""

from __future__ import annotations

import json as json_
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from synth.errors import UserError
from synth.system.cli_errors import Commands

if TYPE_CHECKING:
    from learn.checkpoint import Card
    from learn.data.clips import Clip
    from learn.data.split import Split
    from learn.evaluation.coverage import Coverage
    from learn.evaluation.evaluate import Report
    from learn.evaluation.metrics import Metric
    from learn.evaluation.statistics import Paired
    from learn.settings import Settings
    from learn.uncertainty.intervals import Intervals
    from synth.dataset.split import Rule

app = typer.Typer(
    cls=Commands,
    help="Learn force from displacement.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # "[kPa]" is a unit, not markup
)
_console = Console(stderr=True)

Root = Annotated[Path, typer.Argument(help="Dataset: a folder of NNNNNN.zarr stores.")]
Cache = Annotated[Path | None, typer.Option(help="Folder for packed arrays; made once, shared by runs.")]
_STORED = (
    "A store's displacement: ideal, recovered or noisy, of two eyes motion or motion-ideal; what is "
    "recovered if not given."
)
Threads = Annotated[int | None, typer.Option(help="CPU threads; half the cores if not given.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON on stdout instead of a table.")]


@app.command("train", epilog="Example: learn train out --out model --preset cpu --input mixed")
def train_command(
    dataset: Root,
    changes: Annotated[
        list[str] | None,
        typer.Argument(help="Any setting, as in a model's config.json: loss=mse folds=10 arch.width=32."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the model.")] = Path("model"),
    also: Annotated[
        list[Path] | None, typer.Option(help="A dataset to train on with the first; may be given again.")
    ] = None,
    preset: Annotated[
        str, typer.Option(help="tiny, cpu, live or paper; of two eyes eyes or eyes-live.")
    ] = "cpu",
    input: Annotated[
        str | None,
        typer.Option(
            help="ideal, recovered, noisy (the published noise) or mixed; of two eyes motion (recovered), "
            "motion-ideal or motion-mixed."
        ),
    ] = None,
    epochs: Annotated[int | None, typer.Option(help="Passes over the training frames.")] = None,
    seed: Annotated[int | None, typer.Option(help="Root of all random draws.")] = None,
    accelerator: Annotated[str, typer.Option(help="cpu, cuda or auto.")] = "auto",
    devices: Annotated[int, typer.Option(help="GPUs; under torchrun the number of processes.")] = 1,
    threads: Threads = None,
    cache: Cache = None,
    json: Json = False,
) -> None:
    """Train D2FNet on a dataset. The same command continues an interrupted run."""
    from learn.checkpoint import room_needed
    from learn.data.clips import has_depth
    from learn.settings import override
    from learn.settings import preset as named
    from learn.training.threads import set_threads
    from synth.system.checked_file import made_folder

    set_threads(threads)
    options = {
        "input": input,
        "arch.depth": None if input is None else has_depth(input),
        "epochs": epochs,
        "seed": seed,
    }
    given = [f"{k}={v}" for k, v in options.items() if v is not None] + (changes or [])
    settings, fixed = override(named(preset), given), any(one.startswith("folds=") for one in given)
    with made_folder(out, room_needed(out, settings.arch)):
        datasets = [dataset, *(also or [])]
        clips, split, settings = _divided(datasets, settings, named(preset), cache, fixed=fixed)
        card, first = _train(clips, split, settings, out, accelerator, devices, quiet=json)
    if first:
        _tell_trained(_bounded(card, clips, split, out), settings, out, json)


def _tell_trained(card: Card, settings: Settings, out: Path, json: bool) -> None:
    """The best epoch, on stdout or for a person."""
    result = {"model": str(out), "epoch": card.epoch, "select_r2": card.score}
    result |= {k: len(v) for k, v in card.split.items()}
    no = f"No intervals: {card.no_intervals or 'no epoch was kept'}."
    intervals = no if card.intervals is None else _told(card.intervals)
    if json:
        print(json_.dumps(result))
    else:
        _console.print(
            f"Model in {out}: epoch {card.epoch} of {settings.epochs}, R² {card.score:.3f} on "
            f"{result['select']} select sequences (its force times {card.force_gain:.3g}); "
            f"fitted on {result['fit']}, "
            f"{result['test']} kept for `learn eval`. {intervals}"
        )


def _divided(
    datasets: Sequence[Path], settings: Settings, base: Settings, cache: Path | None, *, fixed: bool
) -> tuple[list[Clip], Split, Settings]:
    """All sequences, who of them is fitted, chooses and is kept, and the settings as that made them.

    `base`: the preset that was changed; `fixed`: whether the number of folds was asked for.
    """
    from learn.data.clips import load_clips, sources
    from learn.data.split import groups, keep_written, nested, ungrouped
    from learn.evaluation.interval_sides import keep_back
    from learn.settings import replace

    clips = []
    for one in datasets:
        with _bar("Reading sequences") as tell:
            clips += load_clips(one, settings.grid, sources(settings.input), cache=cache, report=tell)
    sides, rule = _written(datasets)
    if rule is not None:
        asked = [k for k in ("folds", "fold", "held_out_family") if getattr(settings, k) != getattr(base, k)]
        if asked:
            names = ", ".join(asked)
            raise UserError(
                f"{datasets[0]}: is split already (split.json, by `synth split`): leave out {names}"
            )
        settings = replace(settings, share_anatomy=settings.share_anatomy or rule.share_anatomy)
    if settings.share_anatomy:
        # A written split that doesn't keep openings apart would have one on two sides.
        clips = ungrouped(clips, by_opening=None if rule is None or rule.by == "opening" else False)
        apart = "" if len(set(groups(clips))) == len(clips) else " Its openings are kept apart."
        _console.print(
            f"One brain may be on several sides of the split: scores say nothing of other brains.{apart}"
        )
    if rule is not None:
        _console.print(
            "The dataset's own split: what `synth split` marks test is neither fitted nor chosen on."
        )
        if len(datasets) > 1:
            _check_apart(clips, sides)
        return clips, keep_back(clips, keep_written(clips, sides, settings.seed), settings.seed), settings
    if not fixed:
        settings = replace(settings, folds=min(settings.folds, len(set(groups(clips)))))
    split = nested(clips, settings.folds, settings.fold, settings.seed, settings.held_out_family)
    return clips, keep_back(clips, split, settings.seed), settings


def _check_apart(clips: Sequence[Clip], sides: Mapping[str, str]) -> None:
    """Raises UserError if what must stay together is on one side in one dataset, on another in the next."""
    from learn.data.split import groups

    on: dict[int, set[str]] = {}
    for clip, number in zip(clips, groups(clips), strict=True):
        on.setdefault(number, set()).add(sides.get(clip.content_hash, ""))
    if torn := sum(len(found - {""}) > 1 for found in on.values()):
        raise UserError(
            f"--also: {torn} of the anatomies are on two sides of the datasets' splits; split by their own "
            "(leave out split.json of both), or train on one"
        )


def _written(datasets: Sequence[Path]) -> tuple[dict[str, str], Rule | None]:
    """The sides that `synth split` wrote, by content hash, and its rule; None if there is no split.

    Raises UserError if some datasets are split and others aren't, or by another rule.
    """
    from synth.dataset.index import written_sides
    from synth.dataset.split import read_rule

    found = {one: written_sides(one) for one in datasets}
    rules = {one: None if sides is None else read_rule(one) for one, sides in found.items()}
    first = rules[datasets[0]]
    for one, rule in rules.items():
        if rule != first:
            raise UserError(f"{one}: is not split as {datasets[0]} is: `synth split` both alike, or neither")
    return {name: side for sides in found.values() for name, side in (sides or {}).items()}, first


def _train(
    clips: list[Clip],
    split: Split,
    settings: Settings,
    out: Path,
    accelerator: str,
    devices: int,
    *,
    quiet: bool,
) -> tuple[Card, bool]:
    """Trains with a bar; the best epoch's card, and whether this process is the one that speaks."""
    from learn.training.threads import make_fabric
    from learn.training.train import train

    fabric = make_fabric(accelerator=accelerator, devices=devices, precision=settings.precision)
    with _bar("Training") as tell:
        card = train(
            clips,
            split,
            settings,
            out,
            fabric=fabric,
            report=lambda done, of_, numbers: tell(done, of_),
            log=(lambda numbers: None) if quiet or not fabric.is_global_zero else _log,
        )
    return card, fabric.is_global_zero


def _bounded(card: Card, clips: list[Clip], split: Split, out: Path) -> Card:
    """The card of a trained model with its intervals, fitted if they aren't yet, or why there are none."""
    from learn.evaluation.fit_intervals import add_intervals
    from learn.inference.predict import load_predictor

    if card.intervals is not None or not card.weights_hash:
        return card
    with _bar("Fitting intervals") as tell:
        return add_intervals(out, load_predictor(out), clips, split, report=tell)


def _told(found: Intervals) -> str:
    return f"Intervals from {found.sequences} sequences of {found.units} brains, for {found.source} motion."


def _fit_intervals(
    model: Path, datasets: list[Path], input: str | None, from_test: bool, cache: Path | None
) -> Card:
    """Fits how far off a trained model's answers may be, into its card; that card."""
    from learn.checkpoint import read_card
    from learn.data.clips import load_clips, scored
    from learn.data.split import are_openings, ungrouped
    from learn.evaluation.fit_intervals import add_intervals
    from learn.evaluation.interval_sides import find_obstacle, find_sides
    from learn.inference.predict import load_predictor
    from synth.dataset.index import written_sides

    read_card(model)  # his own: what comes along is not changed
    predictor = load_predictor(model)
    source = predictor.readable(input or scored(predictor.card.settings.input))
    with _bar("Reading sequences") as tell:
        read = [load_clips(one, predictor.grid, (source,), cache=cache, report=tell) for one in datasets]
    clips = [clip for part in read for clip in part]
    if predictor.card.settings.share_anatomy:
        clips = ungrouped(clips, by_opening=are_openings(predictor.card.groups))
    marked = [(written_sides(one) or {}).items() for one in datasets]
    tests = [name for part in marked for name, side in part if side == "test"]
    split = find_sides(clips, predictor.card, tests, from_test)
    if not split.fit:
        raise UserError(
            f"{datasets[0]}: holds no sequence that {model} was fitted on; name its training data"
        )
    why = find_obstacle([clips[i] for i in split.select], [clips[i] for i in split.intervals])
    if why:
        hint = "" if from_test else "; name a dataset that it never met, or say --from-test"
        raise UserError(f"{model}: {why}{hint}")
    with _bar("Fitting intervals") as tell:
        return add_intervals(model, predictor, clips, split, source, tell)


def _log(numbers: dict[str, float]) -> None:
    told = f"epoch {numbers['epoch']:.0f}: loss {numbers['loss']:.4f}, select R² {numbers['select_r2']:.3f}"
    if numbers["share_r2"]:  # of a loss of two parts
        told += f", gradient {numbers['share_error']:.0%} squared error, {numbers['share_r2']:.0%} R²"
    _console.print(told)


@app.command("eval", epilog="Example: learn eval model out --against other-model")
def eval_command(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    dataset: Root,
    input: Annotated[
        str | None,
        typer.Option(
            help="ideal, recovered or noisy; of two eyes motion or motion-ideal; as trained if not given."
        ),
    ] = None,
    against: Annotated[
        Path | None, typer.Option(help="A second model: paired tests on the sequences neither has seen.")
    ] = None,
    all: Annotated[bool, typer.Option("--all", help="Also sequences the model was fitted on.")] = False,
    threads: Threads = None,
    cache: Cache = None,
    json: Json = False,
) -> None:
    """Score a model on the sequences it has not seen; forces in mN."""
    from learn.data.clips import load_clips, scored
    from learn.data.split import are_openings, ungrouped
    from learn.evaluation.coverage import cover
    from learn.evaluation.evaluate import compare, evaluate
    from learn.inference.predict import load_predictor
    from learn.training.threads import set_threads

    set_threads(threads)
    predictor = load_predictor(model)
    source = predictor.readable(input or scored(predictor.card.settings.input))
    with _bar("Reading sequences") as tell:
        clips = load_clips(dataset, predictor.grid, (source,), cache=cache, report=tell)
    if predictor.card.settings.share_anatomy:
        clips = ungrouped(clips, by_opening=are_openings(predictor.card.groups))
        _console.print("The model was chosen on brains it is scored on: this says nothing of other brains.")
    other = None if against is None else load_predictor(against)
    if other is not None:
        other.readable(source)
        if other.grid != predictor.grid or other.card.settings.target != predictor.card.settings.target:
            raise UserError(
                f"{against}: is of another grid or target than {model}; their maps can't be paired"
            )
    cards = [one.card for one in (predictor, other) if one is not None]
    chosen = clips if all else _unseen(clips, dataset, cards)
    with _bar("Evaluating") as tell:
        report = evaluate(predictor, chosen, source, tell)
        second = None if other is None else evaluate(other, chosen, source, tell)
    pairs = {} if second is None else compare(second, report)
    covered = [] if predictor.card.intervals is None else cover(predictor, chosen, source)
    if json:
        found = {"model": str(model), "input": source, **report.as_dict()}
        if covered:
            found["coverage"] = [one.as_dict() for one in covered]
        if second is not None:
            found["against"] = {"model": str(against), "paired": {k: asdict(v) for k, v in pairs.items()}}
        print(json_.dumps(found))
        return
    screen = Console(markup=False)  # "[mN]" is a unit
    screen.print(_table(report, source, all))
    if covered:
        screen.print(_coverage(covered))
    if second is not None:
        screen.print(_pairs(pairs, str(against), predictor.card))


def _unseen(clips: list[Clip], dataset: Path, cards: list[Card]) -> list[Clip]:
    """Those that no model has seen, of a split dataset the test side; UserError if there are none."""
    from learn.evaluation.evaluate import unseen
    from synth.dataset.index import written_sides

    chosen = clips
    for card in cards:
        chosen = unseen(chosen, card)
    sides = written_sides(dataset)
    if sides is not None and "test" in sides.values():
        chosen = [c for c in chosen if sides.get(c.content_hash) == "test"]
        _console.print("The dataset's own split: only what `synth split` marks test is scored.")
    if not chosen:
        raise UserError(
            f"{dataset}: the model was fitted or chosen on every sequence here; --all scores them anyway"
        )
    return chosen


@app.command("predict", epilog="Example: learn predict model video.mp4 --scale 0.05 --young 1.5")
def predict_command(
    model: Annotated[
        Path, typer.Argument(help="Model folder, mono or stereo; may be left out if one of these is there.")
    ],
    source: Annotated[
        Path | None,
        typer.Argument(help="Dataset, NNNNNN.zarr store, video, or .npz of flow.", show_default=False),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for NAME.npz and .force.csv.")] = Path(
        "forces"
    ),
    input: Annotated[str | None, typer.Option(help=_STORED)] = None,
    young: Annotated[float | None, typer.Option(help="Young's modulus [kPa], instead of the data's.")] = None,
    scale: Annotated[
        str | None, typer.Option(help="A video's scale [mm a pixel], or unknown: forces up to a factor.")
    ] = None,
    tissue: Annotated[
        Path | None,
        typer.Option(help="A picture, white where the video shows tissue; everywhere if not given."),
    ] = None,
    flow: Annotated[
        str, typer.Option(help="Flow estimator for a video, as in a job's flow.backend.")
    ] = "tvl1",
    shrink: Annotated[
        int,
        typer.Option(
            min=0, max=8, help="Flow on a video's pictures this many times smaller; 0: to 320 columns."
        ),
    ] = 0,
    rate: Annotated[
        float, typer.Option(min=0.0, help="At most so many frames a second of a video are looked at; 0: all.")
    ] = 10.0,
    pulse: Annotated[
        bool, typer.Option(help="Take the tissue's own motion, heart and breath, off a video's first.")
    ] = True,
    masks: Annotated[
        str,
        typer.Option(
            help="Of a video: auto, none, glare, tool, both, or a folder of NNNNNN.png or mask.png: the tool."
        ),
    ] = "auto",
    overlay: Annotated[bool, typer.Option(help="Also NAME.force.mp4, the force over the film.")] = True,
    threads: Threads = None,
    json: Json = False,
) -> None:
    """Write the force maps and force curves that a model sees in stores, videos or arrays of flow."""
    from learn.inference.apply import Filmed, apply, has_second_eye, motions
    from learn.inference.predict import load_predictor
    from learn.inference.prediction_file import write_overlay, write_prediction
    from learn.inference.shipped import NONE, choose_model, shipped
    from learn.training.threads import set_threads
    from synth.recording_flow.video_flow import Settings
    from synth.video.mask_files import read_choice
    from synth.video.pixel_scale import read_scale

    set_threads(threads)
    if source is None:
        source = model
        chosen = choose_model(has_second_eye(source)) if shipped() else None
        if chosen is None:
            raise UserError(f"{source}: say the model's folder before it: {NONE}")
        model = chosen
    predictor = load_predictor(model, quick=True)
    kind, files = read_choice(masks)
    filmed = Filmed(read_scale(scale), tissue, Settings(flow, shrink, rate or None, pulse, kind), files)
    peaks: dict[str, float | None] = {}
    for motion in motions(source, predictor.stored(input), filmed):
        written = out / f"{motion.name}.npz"
        if written.exists() and written.samefile(source):
            raise UserError(f"{written}: is what is read, and would be overwritten; say another --out")
        found = apply(predictor, motion, young)
        write_prediction(found, out / motion.name)
        if overlay:
            one = source.is_file() or source.suffix == ".zarr"
            write_overlay(found, source if one else source / f"{motion.name}.zarr", out / motion.name)
        peaks[motion.name] = _say_peak(found, motion.name, quiet=json)
    if json:
        print(json_.dumps({"out": str(out), "peak_force_mn": peaks}))


def _say_peak(found: Mapping[str, Any], name: str, *, quiet: bool) -> float | None:
    """The peak [mN] of what `apply` found, None where no frame could be followed; prints it and the notes."""
    size = found["total_force_mn"][found["trusted"]]
    peak = float(size.max()) if len(size) else None
    if not quiet:
        said = "no force: no frame could be followed" if peak is None else f"peak force {peak:.3g} mN"
        _console.print(f"{name}: {len(found['trusted'])} frames, {said}")
        for note in found["notes"]:
            _console.print(f"note: {note}", style="yellow", markup=False, highlight=False)
    return peak


@app.command("calibrate", epilog="Example: learn calibrate model press.npz")
def calibrate_command(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    data: Annotated[
        list[Path],
        typer.Argument(
            help="One press with known force (NNNNNN.zarr store, or .npz with force_mn), or datasets: the "
            "training data, and any with sequences that the model never met."
        ),
    ],
    input: Annotated[str | None, typer.Option(help=_STORED)] = None,
    from_test: Annotated[
        bool,
        typer.Option(
            "--from-test",
            help="Of datasets: take half of the test's brains; `learn eval` leaves them out then.",
        ),
    ] = False,
    threads: Threads = None,
    cache: Cache = None,
    json: Json = False,
) -> None:
    """From one press the tissue's stiffness; from datasets a model's intervals, into its card."""
    from learn.inference.apply import calibrate, motions
    from learn.inference.predict import load_predictor
    from learn.training.threads import set_threads

    set_threads(threads)
    if any(one.suffix not in (".npz", ".zarr") for one in data):
        intervals = _fit_intervals(model, data, input, from_test, cache).intervals
        assert intervals is not None
        found = {"units": intervals.units, "sequences": intervals.sequences, "input": intervals.source}
        if json:
            print(json_.dumps({"model": str(model), **found}))
        else:
            _console.print(_told(intervals))
        return
    predictor = load_predictor(model)
    presses = [motion for one in data for motion in motions(one, predictor.stored(input))]
    young = {press.name: calibrate(predictor, press) for press in presses}
    if json:
        print(json_.dumps({"young_kpa": young}))
        return
    for name, kpa in young.items():
        Console().print(f"{name}: E = {kpa:.3g} kPa; give it to `learn predict` as --young {kpa:.3g}")


@app.command("export", epilog="Example: learn export model d2fnet.onnx --format onnx")
def export_command(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    file: Annotated[Path, typer.Argument(help="File to write; NAME.json beside it says how to use it.")],
    format: Annotated[str, typer.Option(help="torchscript or onnx.")] = "torchscript",
) -> None:
    """Write a model for other programs, checked against PyTorch to 1e-4."""
    from learn.inference.export import export
    from learn.inference.predict import load_predictor

    worst = export(load_predictor(model), file, format)
    _console.print(f"{file}: differs from PyTorch by at most {worst:.1e} of full scale")


@app.command("models", epilog="Example: learn models")
def models_command(json: Json = False) -> None:
    """List the networks that come with this version."""
    from learn.checkpoint import read_card
    from learn.inference.shipped import NONE, describe, hash_data, shipped, size_bytes

    found = {name: (folder, read_card(folder)) for name, folder in shipped().items()}
    if json:
        rows = [
            {
                "name": name,
                "folder": str(folder),
                "bytes": size_bytes(folder),
                "data": hash_data(card),
                "eyes": 2 if card.settings.arch.depth else 1,
                "select_r2": card.score,
            }
            for name, (folder, card) in found.items()
        ]
        print(json_.dumps(rows))
        return
    for name, (folder, card) in found.items():
        print(f"{name}: {describe(card)}, {size_bytes(folder) / 1e6:.1f} MB ({folder / 'README.md'})")
    if not found:
        print(NONE)


def _table(report: Report, source: str, seen: bool) -> Table:
    from learn.evaluation.evaluate import YOUNG
    from learn.evaluation.metrics import METRICS

    which = "sequences, seen ones too" if seen else "unseen sequences"
    table = _open_table(f"{len(report.clips)} {which}, {source} flow; mean over sequences")
    for head in ("E known [95%]", "E × ½", "E × 2", "E unknown"):
        table.add_column(head, justify="right", no_wrap=True)
    columns, sure = [report.summary(y) for y in YOUNG], report.intervals()
    for key, metric in METRICS.items():
        if not metric.listed or key not in columns[0]:
            continue
        cells = [_cell(metric, c.get(key)) for c in columns]
        if key in sure and sure[key].low == sure[key].low:
            cells[0] += f" [{_cell(metric, sure[key].low)}, {_cell(metric, sure[key].high)}]"
        table.add_row(_label(metric, report.card), *cells)
    return table


def _open_table(title: str) -> Table:
    """A table that keeps its numbers whole in eighty columns: labels wrap, there are no upright lines."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("", overflow="fold")
    return table


def _coverage(covered: list[Coverage]) -> Table:
    """Whether the model's intervals hold, and how wide they are."""
    table = _open_table("intervals")
    for one in covered:
        table.add_column(f"{one.level:.0%}", justify="right", no_wrap=True)
    shares = [
        {
            "force within": one.size,
            **{f"{axis} within": share for axis, share in zip("xyz", one.axes, strict=True)},
        }
        for one in covered
    ]
    for name in shares[0]:
        held = [share[name] for share in shares]
        table.add_row(name, *(f"{s.mean:.0%} [{s.low:.0%}, {s.high:.0%}]" for s in held))
    table.add_row("width of the force's [mN]", *(f"{one.width_mn:.3g}" for one in covered))
    table.add_row("the same over the peak", *(f"{one.width_of_peak:.0%}" for one in covered))
    table.add_row("moving frames of an unseen world", *(f"{one.unseen:.0%}" for one in covered))
    return table


def _pairs(pairs: Mapping[str, Paired], against: str, card: Card) -> Table:
    """Differences, this model minus the other, sequence by sequence."""
    from learn.evaluation.metrics import METRICS

    table = _open_table(f"against {against}, paired by sequence")
    for head in ("difference [95%]", "p", "larger on"):
        table.add_column(head, justify="right", no_wrap=True)
    for key, metric in METRICS.items():
        if metric.listed and key in pairs:
            d, pair = pairs[key].difference, pairs[key]
            table.add_row(
                _label(metric, card),
                f"{d.mean:+.3g} [{d.low:+.3g}, {d.high:+.3g}]",
                f"{pair.p:.2g}",
                f"{pair.wins:.0%}",
            )
    return table


def _label(metric: Metric, card: Card) -> str:
    """A score's heading, in the unit of the model's map."""
    return metric.heading.replace("mN/mm²", "mN") if card.settings.target == "intensity" else metric.heading


def _cell(metric: Metric, value: float | None) -> str:
    return "-" if value is None or value != value else f"{value:.{metric.digits}g}"


@contextmanager
def _bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar with what is left of the time, on stderr."""
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=_console,
        transient=True,
        disable=not _console.is_terminal,  # in a log a bar is an empty line
    ) as progress:
        task = progress.add_task(what, total=None)
        yield lambda done, of: progress.update(task, completed=done, total=of)


if __name__ == "__main__":
    app()
