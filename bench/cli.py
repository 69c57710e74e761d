"""The `bench` command. Heavy imports are inside the commands, so that `bench --help` answers at once."""

from __future__ import annotations

import json as json_
import math
import shlex
import sys
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from bench.importers.import_formats import list_endings
from learn.inference import video_options
from synth.errors import UserError, as_user_error
from synth.job.types import MembraneState
from synth.system.cli_errors import Commands, printable

if TYPE_CHECKING:
    from bench.scoring.result import Result
    from bench.tracking.live import LiveFrame

app = typer.Typer(
    name="bench",
    cls=Commands,
    help="Scores recordings against their force sensors, and compares methods.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # "[kPa]" is a unit, not markup
)

Backend = Annotated[str, Option(help="Flow estimator, as in a job's flow.backend.")]
Young = Annotated[float | None, Option(help="Young's modulus of the tissue [kPa], if known.")]
Phantom = Annotated[bool, Option("--phantom", help="A phantom: forces above 50 N are allowed.")]
ModelFolder = Annotated[
    Path | None, Option("--model", "-m", help="A model's folder, or stereo. Default: physics.")
]
Json = Annotated[bool, Option("--json", help="Print JSON to standard output.")]


@app.command(epilog="Example: bench score recording --model model --also other=other-model")
def score(
    recording: Annotated[Path, Argument(help="Recording folder: meta.yaml, video or frames, force.csv.")],
    model: ModelFolder = None,
    out: Annotated[Path | None, Option("--out", "-o", help="Folder to write; default NAME-score.")] = None,
    flow: Backend = "tvl1",
    shrink: video_options.Shrink = 0,
    rate: Annotated[float, Option(min=0.0, help="Largest number of frames a second; 0: all.")] = 10.0,
    pulse: Annotated[bool, Option(help="Subtract heartbeat and breathing from the motion.")] = True,
    title: Annotated[str, Option(help="Heading of the report.")] = "",
    also: Annotated[list[str] | None, Option(help="A further model, as NAME=FOLDER.")] = None,
    main: Annotated[
        str | None, Option(help="Method that the report is about. Default: the model, else physics.")
    ] = None,
    phantom: Phantom = False,
    masks: video_options.Masks = "auto",
    region: Annotated[str, Option(help="LEFT,TOP,WIDTH,HEIGHT [px]: track only this part.")] = "",
    json: Json = False,
) -> None:
    """Estimates force from a recording's video and scores it against the sensor: score.json, report.html.

    Prints no table and exits with code 2 if the recording can't be measured.
    """
    from threadpoolctl import threadpool_limits

    from bench.methods.comparison import PHYSICS
    from bench.methods.network import Model
    from bench.recording.recording_folder import open_recording
    from bench.scoring import score as scoring
    from bench.scoring.result import as_json
    from learn.training.threads import choose_threads
    from synth.video.mask_files import read_choice

    others = _parse_pairs("--also", also, "NAME=FOLDER")
    kind, files = read_choice(masks)
    opened_recording = open_recording(recording, phantom).restrict(files, _parse_rectangle(region))
    folder = out or Path(f"{opened_recording.name}-score")
    # NumPy's BLAS too: its threads would compete with the flow for the same cores.
    threadpool_limits(choose_threads())
    result = scoring.score(
        opened_recording,
        model,
        methods={name: Model(Path(path)) for name, path in others.items()},
        main=main or (None if model else PHYSICS),
        settings=scoring.Settings(flow, shrink, rate or None, pulse, kind),
        out=folder,
        title=title,
        progress=True,
        own_process=True,
    )
    if json:
        print(json_.dumps(as_json(result), allow_nan=False))
    else:
        _print_result(result, folder)
    if result.refused:
        raise typer.Exit(2)


def _print_result(result: Result, folder: Path) -> None:
    """Prints warnings, the table, notes and the report's path."""
    from rich.console import Console

    from bench.scoring.headline import headline
    from bench.scoring.score_report import terminal_table

    console, summary = Console(), headline(result)
    doubts = [finding.message for finding in result.tracked.doubt]
    for line in filter(None, dict.fromkeys([*doubts, summary.refused, *summary.warnings])):
        console.print(line, style="bold red", markup=False, highlight=False)
    if not result.refused:
        console.print(terminal_table(result))
    for note in result.notes:
        console.print(f"note: {note}", style="yellow", markup=False, highlight=False)
    # Never wrapped, so that the path can be copied.
    console.print(f"report: {folder / 'report.html'}", markup=False, highlight=False, soft_wrap=True)


@app.command(epilog="Example: bench estimate video.mp4 --scale 0.05 --young 1.5")
def estimate(
    source: Annotated[Path, Argument(help="Video, PNGs' folder, dataset, store, or .npz of flow.")],
    out: Annotated[Path, Option("--out", "-o", help="Folder for NAME.npz and .force.csv.")] = Path("forces"),
    scale: video_options.Scale = None,
    young: Young = None,
    young_uncertainty: Annotated[
        float, Option(min=0.0, max=0.999, help="Its relative standard deviation: widens the interval.")
    ] = 0.0,
    membrane: Annotated[MembraneState, Option(help="Of the pia.")] = "unknown",
    membrane_mn_per_mm: Annotated[
        tuple[float, float] | None, Option(help="Range of its thickness times Young's modulus, if known.")
    ] = None,
    relaxation: Annotated[
        list[str] | None,
        Option(help="Stiffness lost, SHARE:SECONDS; --young is then instantaneous; may be repeated."),
    ] = None,
    living: Annotated[bool, Option("--living/--ex-vivo", help="Whether heart and breath move it.")] = True,
    free: Annotated[
        list[str] | None, Option(help="Span without contact, START:END in s of the video; may be repeated.")
    ] = None,
    right: video_options.Right = None,
    calibration: video_options.Calibration = None,
    mm_per_unit: video_options.MmPerUnit = 1.0,
    tissue: video_options.Tissue = None,
    masks: video_options.Masks = "auto",
    input: Annotated[str | None, Option(help="Displacement of stored sequences, as in `learn eval`.")] = None,
    flow: Backend = "tvl1",
    shrink: video_options.Shrink = 0,
    rate: video_options.Rate = 10.0,
    rest: video_options.Rest = 0,
    pulse: video_options.Pulse = True,
    overlay: video_options.Overlay = True,
    json: Json = False,
) -> None:
    """Estimates the force in a video by physics, without a network, a sensor or a recording folder.

    The video's first frame, or --rest, shows the tissue unloaded. With a second camera (--right) force along
    the line of sight is measured as well.

    Exit code 2 if no frame has a force.
    """
    from threadpoolctl import threadpool_limits

    from bench.tracking.estimate import apply_physics, choose_input
    from learn.inference.prediction_file import predict_files, summarise
    from learn.inference.video_motion import SecondCamera, motions, read_options
    from learn.training.threads import choose_threads
    from synth.flow.recording.decode import RecordingFlowSettings
    from synth.video.pixel_scale import read_scale

    settings = RecordingFlowSettings(flow, shrink, rate or None, pulse)
    second = SecondCamera.of(right, calibration, mm_per_unit)
    options = read_options(read_scale(scale), tissue, masks, settings, rest_frame=rest, second=second)
    threadpool_limits(choose_threads())
    by_physics = partial(
        apply_physics,
        young_kpa=young,
        membrane=membrane,
        membrane_mn_per_mm=membrane_mn_per_mm,
        living=living,
        given=options.given,
        young_uncertainty=young_uncertainty,
        free_s=[_parse_span(text) for text in free or ()],
        relaxation=[_parse_pair(text, "--relaxation", "SHARE:SECONDS") for text in relaxation]
        if relaxation
        else None,
    )
    videos, predictions = motions(source, choose_input(source, input), options), []
    for file in predict_files(by_physics, videos, source, out, overlay):
        predictions.append(file)
        if not json:
            for note in file.notes:
                typer.echo(f"note: {file.name}: {note}", err=True)
            typer.echo(file.text)
    if json:
        print(json_.dumps(summarise(predictions, out)))
    if all(file.peak_mn is None for file in predictions):
        raise typer.Exit(2)


@app.command(epilog="Example: bench pool a-score b-score --out pooled")
def pool(
    scores: Annotated[list[Path], Argument(help="Folders that `bench score` wrote, or their score.json.")],
    out: Annotated[Path, Option("--out", "-o", help="Folder for the pooled result.")],
    json: Json = False,
) -> None:
    """Pools the scores of several recordings: means, intervals over specimens, one table."""
    from bench.scoring import pool as pooling

    tree = pooling.pool(pooling.read(scores))
    pooling.write(tree, out, shlex.join(["bench", *sys.argv[1:]]))
    print(json_.dumps(tree) if json else out / "README.md")


@app.command(epilog="Example: bench report monday/* --out monday-report")
def report(
    recordings: Annotated[list[Path], Argument(help="Recording folders.")],
    out: Annotated[Path, Option("--out", "-o", help="Folder for the page, and a report of each.")],
    json: Json = False,
) -> None:
    """Scores several recordings by physics: one page, pooled scores, a report of each."""
    from threadpoolctl import threadpool_limits

    from bench.scoring.session_report import PAGE, report_recordings
    from learn.training.threads import choose_threads

    threadpool_limits(choose_threads())
    rows = report_recordings(recordings, out, shlex.join(["bench", *sys.argv[1:]]))
    print(json_.dumps(rows) if json else out / PAGE)


@app.command(epilog="Example: bench init recording")
def init(
    recording: Annotated[Path, Argument(help="Recording folder; it may exist.")],
    protocol: Annotated[bool, Option("--protocol", help="Also write what to record: protocol.md.")] = False,
    tissue: Annotated[
        bool, Option("--tissue", help="Only propose a tissue.png for the video, to be edited.")
    ] = False,
) -> None:
    """Writes a recording's meta.yaml with an explanation of every key."""
    from bench.checks.protocol import as_markdown
    from bench.recording.meta import document_meta

    if tissue and protocol:
        raise UserError("--tissue only proposes tissue.png; leave out --protocol")
    if tissue:
        from bench.recording.propose_tissue import propose_tissue

        mask, preview, doubt = propose_tissue(recording)
        print(f"wrote {mask}: white on all tissue; edit it in any paint program. On the picture: {preview}")
        if doubt:
            typer.echo(f"warning: {doubt}", err=True)
        return
    keeps_meta = protocol and (recording / "meta.yaml").exists()
    files = {} if keeps_meta else {"meta.yaml": document_meta()}
    if protocol:
        files["protocol.md"] = as_markdown()
    for name, text in files.items():
        with as_user_error(f"{recording / name}: cannot be written"):
            recording.mkdir(parents=True, exist_ok=True)
            with (recording / name).open("x", encoding="utf-8") as file:
                file.write(text)
    written = " and ".join(str(recording / name) for name in files)
    print(f"wrote {written}; fill in meta.yaml, then: bench check {recording}")


@app.command(epilog="Example: bench check recording")
def check(
    recording: Annotated[Path, Argument(help="Recording folder.")],
    phantom: Phantom = False,
    picture: Annotated[Path | None, Option(help="PNG to write: tissue, masks, flow of five frames.")] = None,
    json: Json = False,
) -> None:
    """Reports what of a recording is usable and what is missing. Exits with code 2 if it can't be used."""
    from dataclasses import asdict

    from bench.checks.check_recording import check_recording
    from synth.flow.recording.finding import first_fault
    from synth.system.checked_file import make_folder
    from synth.system.terminal import hang

    if picture is not None:
        make_folder(picture.parent)  # fails before the video is decoded
    findings = check_recording(recording, phantom, picture)
    usable = not first_fault(findings)
    if json:
        print(json_.dumps({"usable": usable, "findings": [asdict(finding) for finding in findings]}))
    else:
        for finding in findings:
            print("\n".join(hang(f"{finding.severity:<8}{finding.cause:<11}", printable(finding.message))))
    if not usable:
        raise typer.Exit(2)


@app.command(
    "import", epilog="Example: bench import a.mcap --out recording --scale 0.05 --use force=/ft/wrench"
)
def import_(
    source: Annotated[
        Path,
        Argument(help=f"A video, {list_endings()}, or a folder of pictures, chapters or of a bag."),
    ],
    out: Annotated[Path, Option("--out", "-o", help="Recording folder to write.")],
    scale: Annotated[str | None, Option(help="mm per pixel, or unknown; else edit meta.yaml.")] = None,
    young: Young = None,
    use: Annotated[
        list[str] | None,
        Option(
            help="ROLE=NAME where the choice is ambiguous: frames, frame_time, force, force_time, fps, "
            "right, calibration, columns (of the table of forces), stream (of a video), start (picture or "
            "file); in a ROS bag also depth, right_calibration."
        ),
    ] = None,
    stereo_layout: Annotated[
        str | None,
        Option(
            help="Two cameras in one video: side-by-side, top-bottom, half-width, half-height (squeezed), "
            "alternating, rows or columns; add ,right-first if so."
        ),
    ] = None,
    newtons: Annotated[
        float | None,
        Option(
            min=1e-9, help="Newtons per unit of force: 0.001 for mN; default: as the source states, or 1."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Converts another system's recording into a recording folder."""
    from bench.importers import importer_registry
    from synth.system.terminal import counting
    from synth.video.pixel_scale import read_scale

    intake = importer_registry.read_source(source, _parse_pairs("--use", use, "ROLE=NAME"), stereo_layout)
    meta_keys: dict[str, object] = {"young_kpa": young if young is not None else "unknown"}
    if scale is not None:
        meta_keys["scale_mm_per_px"] = read_scale(scale)
    with counting(f"importing {source.name}", len(intake.times_s)) as progress:
        importer_registry.write_recording(intake, out, newtons, meta_keys, progress)
    notes = list(intake.notes)
    if scale is None and (intake.second is None or intake.second.pair is None):
        notes.append("meta.yaml still needs scale_mm_per_px or calibration")
    if not len(intake.force):
        notes.append("no force: predictions only")
    if json:
        print(json_.dumps({"recording": str(out), "frames": len(intake.times_s), "notes": notes}))
    else:
        for note in notes:
            typer.echo(f"note: {note}", err=True)
        print(out)


@app.command("from-dataset", epilog="Example: bench from-dataset out --out recordings --sequence 3")
def from_dataset(
    dataset: Annotated[Path, Argument(help="A rendered dataset.")],
    out: Annotated[Path, Option("--out", "-o", help="Folder for one recording per sequence.")],
    sequence: Annotated[int | None, Option(help="Only this sequence.")] = None,
    unseen_by: Annotated[
        list[Path] | None, Option(help="Only the first sequence a model was not trained on; repeatable.")
    ] = None,
    instrument: Annotated[int | None, Option(help="Force of this instrument alone, from 1.")] = None,
    json: Json = False,
) -> None:
    """Writes sealed sequences as recording folders, to be scored like real recordings."""
    from bench.recording.from_sequence import export_recording, force_of
    from learn.checkpoint import read_card
    from learn.inference.shipped_networks import find_model
    from synth.dataset.store import Dataset

    sequences = [entry for entry in Dataset(dataset) if sequence is None or entry.index == sequence]
    if not sequences:
        raise UserError(f"{dataset}: holds no finished sequence {sequence}")
    if unseen_by:
        used_hashes = set[str]().union(*(read_card(find_model(model)).used for model in unseen_by))
        sequences = [entry for entry in sequences if entry.attrs["content_hash"] not in used_hashes][:1]
    if not sequences:
        raise UserError(f"{dataset}: a model was fitted or chosen on each of these sequences")
    for entry in sequences:
        force_of(entry, instrument)  # refused before anything is written
    names = [str(export_recording(entry, out / f"{entry.index:06d}", instrument)) for entry in sequences]
    print(json_.dumps({"recordings": names}) if json else "\n".join(names))


def _parse_pairs(option: str, words: list[str] | None, form: str) -> dict[str, str]:
    """The A=B values of a repeated option as a dictionary. UserError if one has another form."""
    pairs = {}
    for word in words or ():
        name, separator, value = word.partition("=")
        if not (name and separator and value):
            raise UserError(f"{option} {word}: expected {form}")
        pairs[name] = value
    return pairs


@app.command(epilog="Example: bench live video.mp4 --model model --scale 0.05 --young 1.5")
def live(
    video: Annotated[Path, Argument(help="Or a camera: its number, or /dev/video0. It begins at rest.")],
    model: Annotated[Path | None, Option("--model", "-m", help="A model's folder, for forces.")] = None,
    scale: Annotated[str | None, Option(help="mm per pixel, or unknown; needed with a model.")] = None,
    young: Young = None,
    flow: Backend = "tvl1",
    shrink: Annotated[int, Option(min=0, max=64, help="Shrink frames first; 0: to 160 columns.")] = 0,
    masks: video_options.Masks = "auto",
    tissue: Annotated[
        Path | None, Option(help="Picture, white on tissue. Default: tissue.png next to a video.")
    ] = None,
    seconds: Annotated[float | None, Option(min=0.1, help="Of a camera. Default: until Ctrl-C.")] = None,
    every: Annotated[bool, Option("--every", help="Process every frame, however late.")] = False,
    json: Json = False,
) -> None:
    """Computes masks, flow and force of a camera or a video as it plays: latency, and dropped frames."""
    from threadpoolctl import threadpool_limits

    from bench.methods.network import Model
    from bench.tracking import live
    from bench.tracking.capture import Camera, is_camera
    from learn.training.threads import choose_threads
    from synth.flow.estimator import name_motion
    from synth.flow.recording.decode import LIVE_COLUMNS, Footage, RecordingFlowSettings
    from synth.flow.recording.flow import open_flow_process
    from synth.video.mask_files import read_choice
    from synth.video.pixel_scale import UNKNOWN_NOTE, read_scale
    from synth.video.read_video import FPS, read_mask, read_video

    kind, files = read_choice(masks)
    is_filmed = is_camera(video)
    if is_filmed and (files or every):
        raise UserError(f"{video}: a camera has no files of masks, and its frames don't wait for --every")
    if seconds is not None and not is_filmed:
        raise UserError(f"--seconds: {video} is no camera")
    tissue_file = tissue or (None if is_filmed else video.parent / "tissue.png")
    mask = partial(read_mask, tissue_file) if tissue_file and (tissue or tissue_file.exists()) else None
    threadpool_limits(choose_threads())
    method = None if model is None else Model(model)
    for note in [] if method is None else method.predictor.card.doubt(name_motion(flow)):
        typer.echo(f"warning: network: {note}", err=True)
    with ExitStack() as stack:
        process = stack.enter_context(open_flow_process())
        camera = stack.enter_context(closing(Camera(video))) if is_filmed else None
        reader = partial(read_video, video, FPS) if camera is None else camera.pictures
        footage = Footage(reader, str(video), mask, files.read if files else None)
        stream = live.stream_video(
            footage,
            RecordingFlowSettings(flow, shrink, None, False, kind, LIVE_COLUMNS),
            method=method,
            scale_mm_per_px=read_scale(scale),
            young_kpa=young,
            paced=not every,
            report=(lambda frame: None) if json else _print_frame,
            flow=process,
            camera=camera,
            seconds=seconds or math.inf,
        )
    summary = stream.summary()
    for finding in stream.findings:
        typer.echo(f"{finding.severity}: {finding.cause}: {finding.message}", err=True)
    if scale == "unknown":
        typer.echo(f"note: {UNKNOWN_NOTE}", err=True)
    print(
        json_.dumps(summary) if json else ", ".join(f"{name} {value:.4g}" for name, value in summary.items())
    )


def _print_frame(frame: LiveFrame) -> None:
    force = "" if frame.force_mn is None else f"  {frame.force_mn:8.2f} mN"
    mark = "" if frame.trusted else "  not trusted"
    timing = f"{1e3 * frame.latency_s:7.1f} ms  {frame.largest_px:6.2f} px"
    print(f"frame {frame.index:5}  {timing}{force}{mark}", flush=True)


def _parse_span(text: str) -> tuple[float, float]:
    """Parses START:END in seconds. UserError for anything else, and if it does not run forward."""
    span = _parse_pair(text, "--free", "START:END in seconds of the video")
    if not span[0] < span[1]:
        raise UserError(f"--free {text}: does not end after it starts")
    return span


def _parse_pair(text: str, option: str, form: str) -> tuple[float, float]:
    """Parses two numbers with a colon between. UserError for anything else."""
    first, _, second = text.partition(":")
    with as_user_error(f"{option} {text}: expected {form}"):
        return float(first), float(second)


def _parse_rectangle(text: str) -> tuple[int, int, int, int] | None:
    """Parses LEFT,TOP,WIDTH,HEIGHT; None if empty. UserError for anything else."""
    if not text:
        return None
    try:
        left, top, width, height = (int(part) for part in text.split(","))
    except ValueError:
        left = top = width = height = -1
    if min(left, top) < 0 or min(width, height) < 1:
        raise UserError(f"--region {text}: give LEFT,TOP,WIDTH,HEIGHT in pixels, inside the picture")
    return left, top, width, height
