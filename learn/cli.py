"""`learn train | eval | predict | calibrate | export | models`: trained models, their scores and forces."""

from __future__ import annotations

import json as json_
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from typer import Argument, Option

from learn.inference import video_options
from synth.errors import UserError
from synth.job.types import MembraneState
from synth.system.cli_errors import Commands
from synth.system.terminal import counting

if TYPE_CHECKING:
    from learn.data.clips import Clip
    from learn.data.grid import Grid
    from learn.settings import TrainingSettings
    from learn.split import Split
    from learn.uncertainty.intervals import Intervals

app = typer.Typer(
    cls=Commands,
    help="Learn force from displacement.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # "[kPa]" is a unit, not markup
)
_console = Console(stderr=True)

Root = Annotated[Path, Argument(help="Dataset: a folder of NNNNNN.zarr stores.")]
Cache = Annotated[Path | None, Option(help="Folder for packed arrays, reused by later runs.")]
Input = Annotated[
    str | None,
    Option(
        help="Displacement read from a store: ideal, recovered or noisy; of a stereo model motion or "
        "motion-ideal. Default: recovered; for `learn eval` as in training."
    ),
]
Threads = Annotated[int | None, Option(help="CPU threads. Default: half the cores.")]
Json = Annotated[bool, Option("--json", help="Print JSON on stdout instead of a table.")]


@app.command(
    "train",
    epilog="Example: learn train out --out model --preset cpu --input mixed",
    context_settings={"ignore_unknown_options": True},
)
def train_command(
    dataset: Root,
    changes: Annotated[
        list[str] | None, Argument(help="Settings of config.json, as --input mixed or arch.width=32.")
    ] = None,
    out: Annotated[Path, Option("--out", "-o", help="Folder for the model.")] = Path("model"),
    also: Annotated[list[Path] | None, Option(help="A further training dataset; repeat for more.")] = None,
    labels: Annotated[list[Path] | None, Option(help="A dataset of which only the truth is used.")] = None,
    start: Annotated[str | None, Option(help="A model to start from: a folder, or stereo.")] = None,
    preset: Annotated[str, Option(help="tiny, cpu, live, paper or ridge; stereo or stereo-live.")] = "cpu",
    accelerator: Annotated[str, Option(help="cpu, cuda or auto.")] = "auto",
    threads: Threads = None,
    cache: Cache = None,
    json: Json = False,
) -> None:
    """Train a network on a dataset. The same command continues an interrupted run."""
    from learn.checkpoint import disk_needed, read_model
    from learn.evaluation.fit_intervals import add_intervals
    from learn.inference.predict import load_model
    from learn.inference.shipped_networks import find_model
    from learn.settings import change_preset
    from learn.training.threads import choose_device, set_threads
    from learn.training.train import train
    from synth.system.checked_file import open_folder

    set_threads(threads)
    device = choose_device(accelerator)
    dataset, overrides = _split_arguments(str(dataset), changes or [])
    settings = change_preset(preset, overrides)
    begin = read_model(find_model(start)) if start else None
    with open_folder(out, disk_needed(out, settings)):
        clips, split = _divide([dataset, *(also or [])], labels or [], settings, cache)
        log = (lambda numbers: None) if json else _log
        with counting("Training") as progress:
            card = train(clips, split, settings, out, start=begin, device=device, report=progress, log=log)
    if card.intervals is None and card.weights_hash:
        with counting("Fitting intervals") as progress:
            card = add_intervals(out, load_model(out), clips, split, report=progress)
    result = {"model": str(out), "epoch": card.epoch, "select_r2": card.score}
    result |= {part: len(hashes) for part, hashes in card.split.items()}
    if json:
        print(json_.dumps(result))
        return
    why = f"No intervals: {card.no_intervals or 'no epoch was stored'}."
    _console.print(
        f"Model in {out}: epoch {card.epoch} of {settings.epochs}, R² {card.score:.3f} on {result['select']} "
        f"select sequences (its force times {card.force_gain:.3g}); fitted on {result['fit']}, "
        f"{result['test']} left for `learn eval`. {_describe(card.intervals) if card.intervals else why}"
    )


def _split_arguments(first: str, words: Sequence[str]) -> tuple[Path, dict[str, str]]:
    """The dataset, and settings in any order around it. UserError unless there is exactly one dataset."""
    from learn.settings import as_changes

    # A dataset that stands first may have = in its name.
    settings, others = as_changes([first, *words] if first.startswith("--") else words)
    datasets = others if first.startswith("--") else [first, *others]
    if len(datasets) != 1:
        raise UserError(f"needs one DATASET, got {' '.join(datasets) or 'none'}; settings are KEY=VALUE")
    return Path(datasets[0]), settings


def _read(datasets: Iterable[Path], grid: Grid, wanted: Sequence[str], cache: Path | None) -> list[Clip]:
    from learn.data.clips import load_clips

    clips: list[Clip] = []
    for dataset in datasets:
        with counting("Reading sequences") as progress:
            clips += load_clips(dataset, grid, wanted, cache=cache, report=progress)
    return clips


def _divide(
    datasets: Sequence[Path], labels: Sequence[Path], settings: TrainingSettings, cache: Path | None
) -> tuple[list[Clip], Split]:
    """The sequences of datasets and of those for labels, and what each is for."""
    from learn.data.clips import sources
    from learn.split import add_labels, divide

    wanted = sources(settings.input)
    if labels and len(wanted) < 2:
        raise UserError(f"--labels needs a mixed input, not {settings.input}")
    clips = _read(datasets, settings.grid, wanted, cache)
    clips, split = divide(clips, datasets, settings.seed, _console.print)
    count, truth = len(split.fit), _read(labels, settings.grid, wanted[:1], cache)
    clips, split = add_labels(clips, split, truth)
    if labels:
        _console.print(f"{len(split.fit) - count} of {len(truth)} sequences of --labels are trained on.")
    return clips, split


def _describe(intervals: Intervals) -> str:
    basis = f"{intervals.sequences} sequences of {intervals.units} brains"
    return f"Intervals from {basis}, for {intervals.source} motion."


def _log(numbers: Mapping[str, float]) -> None:
    score = f"loss {numbers['loss']:.4f}, select R² {numbers['select_r2']:.3f}"
    _console.print(f"epoch {numbers['epoch']:.0f}: {score}")


def _note(text: str) -> None:
    _console.print(f"note: {text}", style="yellow", markup=False, highlight=False)


@app.command("eval", epilog="Example: learn eval model out")
def eval_command(
    model: Annotated[Path, Argument(help="Model folder.")],
    dataset: Root,
    input: Input = None,
    all: Annotated[bool, Option("--all", help="Print all scores, not just four.")] = False,
    threads: Threads = None,
    cache: Cache = None,
    json: Json = False,
) -> None:
    """Score a model on sequences that it was not trained on; forces in mN."""
    from learn.data.clips import RECOVERED, scored_source
    from learn.evaluation.coverage import cover
    from learn.evaluation.evaluate import evaluate
    from learn.evaluation.tables import coverage_table, score_table
    from learn.inference.predict import load_model
    from learn.split import choose_unseen, find_unit
    from learn.training.threads import choose_threads

    predictor = load_model(model, threads=choose_threads(threads))
    source = predictor.check_source(input or scored_source(predictor.card.settings.input))
    clips = _read([dataset], predictor.grid, (source,), cache)
    if find_unit(predictor.card) != "anatomy":
        _console.print("Training and test share brains: these scores don't apply to other brains.")
    chosen = choose_unseen(clips, dataset, predictor.card, _console.print)
    recovered_by = {clip.recovered_by if source in RECOVERED else "" for clip in chosen}
    for note in {note for source in recovered_by for note in predictor.card.doubt(source)}:
        _note(note)
    with counting("Evaluating") as progress:
        report = evaluate(predictor, chosen, source, progress)
    covered = cover(predictor, chosen, source) if predictor.card.intervals and (all or json) else []
    if json:
        printed = {"model": str(model), "input": source, **report.as_dict()}
        if covered:
            printed["coverage"] = [coverage.as_dict() for coverage in covered]
        print(json_.dumps(printed))
        return
    screen = Console(markup=False)  # "[mN]" is a unit
    title = f"{len(chosen)} unseen sequences, {source} flow; mean over sequences"
    screen.print(score_table(report, title, all))
    if covered and all:
        screen.print(coverage_table(covered))


@app.command("predict", epilog="Example: learn predict model video.mp4 --scale 0.05 --young 1.5")
def predict_command(
    model: Annotated[Path, Argument(help="Folder, or stereo; `bench estimate` needs none.")],
    source: Annotated[Path, Argument(help="Dataset, store, video, PNGs' folder, or .npz of flow.")],
    out: Annotated[Path, Option("--out", "-o", help="Folder for NAME.npz and .force.csv.")] = Path("forces"),
    input: Input = None,
    young: Annotated[float | None, Option(help="Young's modulus [kPa], instead of the data's.")] = None,
    membrane: Annotated[MembraneState, Option(help="Of the pia, for a model with that input.")] = "unknown",
    scale: video_options.Scale = None,
    right: video_options.Right = None,
    calibration: video_options.Calibration = None,
    mm_per_unit: video_options.MmPerUnit = 1.0,
    tissue: video_options.Tissue = None,
    flow: Annotated[str, Option(help="Flow estimator for a video, as in a job's flow.backend.")] = "tvl1",
    shrink: video_options.Shrink = 0,
    rate: video_options.Rate = 10.0,
    rest: video_options.Rest = 0,
    pulse: video_options.Pulse = True,
    masks: video_options.Masks = "auto",
    overlay: video_options.Overlay = True,
    threads: Threads = None,
    json: Json = False,
) -> None:
    """Estimate force maps and force curves from stores, videos or arrays of flow.

    Exit code 2 if no frame has a force.
    """
    from learn.inference.apply import apply, check_cameras
    from learn.inference.predict import load_model
    from learn.inference.prediction_file import predict_files, summarise
    from learn.inference.video_motion import SecondCamera, motions, read_options
    from learn.training.threads import choose_threads
    from synth.flow.recording.decode import RecordingFlowSettings
    from synth.video.pixel_scale import read_scale

    settings = RecordingFlowSettings(flow, shrink, rate or None, pulse)
    second = SecondCamera.of(right, calibration, mm_per_unit)
    options = read_options(read_scale(scale), tissue, masks, settings, rest_frame=rest, second=second)
    predictions = []
    predictor = load_model(model, threads=choose_threads(threads))
    check_cameras(predictor, second)
    videos = motions(source, predictor.choose_source(input), options)
    estimate = partial(apply, predictor, young_kpa=young, membrane=membrane)
    for file in predict_files(estimate, videos, source, out, overlay):
        predictions.append(file)
        if not json:
            for note in file.notes:
                _note(f"{file.name}: {note}")
            _console.print(file.text, markup=False, highlight=False, soft_wrap=True)  # the path can be copied
    if json:
        print(json_.dumps(summarise(predictions, out)))
    if all(file.peak_mn is None for file in predictions):
        raise typer.Exit(2)


@app.command("calibrate", epilog="Example: learn calibrate model press.npz")
def calibrate_command(
    model: Annotated[Path, Argument(help="Model folder.")],
    data: Annotated[list[Path], Argument(help="Presses of known force: .zarr or .npz.")],
    input: Input = None,
    threads: Threads = None,
    json: Json = False,
) -> None:
    """Fit Young's modulus to presses of known force."""
    from learn.inference.apply import calibrate
    from learn.inference.predict import load_model
    from learn.inference.video_motion import motions
    from learn.training.threads import choose_threads

    if wrong := [path for path in data if path.suffix not in (".npz", ".zarr")]:
        raise UserError(f"{wrong[0]}: not a press (.zarr or .npz); intervals are fitted by `learn train`")
    predictor = load_model(model, threads=choose_threads(threads))
    presses = [motion for path in data for motion in motions(path, predictor.choose_source(input))]
    young = {press.name: calibrate(predictor, press) for press in presses}
    if json:
        print(json_.dumps({"young_kpa": young}))
        return
    for name, kpa in young.items():
        Console().print(f"{name}: E = {kpa:.3g} kPa; use it as `learn predict --young {kpa:.3g}`")


@app.command("export", epilog="Example: learn export model d2fnet.onnx")
def export_command(
    model: Annotated[Path, Argument(help="Model folder, or stereo.")],
    file: Annotated[Path, Argument(help="ONNX file; FILE.json next to it describes its use.")],
) -> None:
    """Write a model as ONNX for other programs, checked against PyTorch to 1e-4."""
    from learn.inference.export import export
    from learn.inference.shipped_networks import find_model

    worst = export(find_model(model), file)
    _console.print(f"{file}: differs from PyTorch by at most {worst:.1e} of full scale")


@app.command("models", epilog="Example: learn models")
def models_command(json: Json = False) -> None:
    """List the pretrained networks."""
    from learn.checkpoint import read_card
    from learn.inference.shipped_networks import LICENCE, MODELS, NAMES, describe, hash_data
    from synth.system.checked_file import folder_bytes

    cards = {name: (MODELS / name, read_card(MODELS / name)) for name in NAMES}
    if json:
        rows = [
            {"name": name, "folder": str(folder), "bytes": folder_bytes(folder), "data": hash_data(card)}
            | {"licence": LICENCE}
            | {"cameras": 2 if card.settings.arch.depth else 1, "select_r2": card.score}
            for name, (folder, card) in cards.items()
        ]
        print(json_.dumps(rows))
        return
    for name, (folder, card) in cards.items():
        print(f"{name}: {describe(card)}, {folder_bytes(folder) / 1e6:.1f} MB ({folder / 'README.md'})")
    print(f"licence of the weights: {LICENCE}")
