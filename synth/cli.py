"""The `synth` command. Heavy imports are inside the commands, so that `synth --help` is fast."""

from __future__ import annotations

import json as json_
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from synth.errors import UserError, as_user_error
from synth.publish.export.exporter_registry import EXPORTERS
from synth.system.cli_errors import Commands

if TYPE_CHECKING:
    from synth.job.schema import Job

app = typer.Typer(
    name="synth",
    cls=Commands,
    help="Synthetic microscope sequences of a brain surface under load, with exact force and motion.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # "[kPa]" is a unit, not markup
)

_NAMED = "tiny, demo, mission, clinical, randomized, stereo, flow, in-vivo, ex-vivo-calf, endoscope, paper"
Source = Annotated[str, Argument(help=f"A job file, or a named job: {_NAMED}.")]
Overrides = Annotated[list[str] | None, Argument(help="Changes to the job, as section.key=value.")]
Out = Annotated[Path, Argument(help="A dataset's folder.")]
Index = Annotated[int, Option("--sequence", "-s", help="Which sequence, by its index.")]
Json = Annotated[bool, Option("--json", help="Print JSON to standard output.")]


@app.command(epilog='Example: synth tune demo --budget "force 3%" --out tuned.yaml')
def tune(
    job: Source,
    overrides: Annotated[list[str] | None, Argument(help="Changes, as section.key=value.")] = None,
    budget: Annotated[str, Option(help="By how much the force error may grow.")] = "force 3%",
    out: Annotated[Path | None, Option("--out", "-o", help="To write; else JOB.tuned.yaml.")] = None,
    probes: Annotated[int, Option(min=1, max=50, help="Sequences for every setting.")] = 3,
    checks: Annotated[int, Option(min=0, max=50, help="Further sequences for whole jobs.")] = 3,
) -> None:
    """Writes the cheapest job whose force error is within a budget of full fidelity's.

    On a few probe sequences one parameter at a time is changed (law, mesh, time step, surface, picture,
    paths); the settings chosen are measured as a whole. The job gets no dearer unless it misses the
    budget. A run that was stopped goes on when it is given again.
    """
    from synth.job import reader
    from synth.tune import search

    share, loaded_job = search.parse_budget(budget), reader.load_job(job, overrides or [])
    out = out or Path(f"{Path(job).stem}.tuned.yaml")
    _refuse_to_replace(out)
    tuned = search.tune(search.Measurements(loaded_job), share, probes, checks)
    search.write_job(tuned, job, overrides or [], out)
    print("\n".join([*search.lines(tuned), "", f"wrote {out}"]))


@app.command(epilog="Example: synth fit photo.jpg --out look.yaml --width-mm 38")
def fit(
    photo: Annotated[Path, Argument(help="A photograph of exposed cortex by your microscope.")],
    out: Annotated[Path, Option("--out", "-o", help="The job file to write.")] = Path("appearance.yaml"),
    width_mm: Annotated[float, Option(min=5, max=400, help="The picture's width at the cortex [mm].")] = 35.0,
    mask: Annotated[Path | None, Option(help="A mask of the cortex, white; default: detected.")] = None,
    json: Json = False,
) -> None:
    """Measures a photograph's camera (colours, noise, blur, vignette, codec) and its appearance family."""
    from synth.fit import fitting
    from synth.fit.photograph import read_photograph
    from synth.system.checked_file import write_whole

    _refuse_to_replace(out)
    photograph = read_photograph(photo, width_mm, mask)
    sections = fitting.fit_camera(photograph)
    lines = [
        f"# Measured in {photo.name} by synth fit, on {photograph.cortex_mm2:.0f} mm2 of cortex.",
        f"# Blur and noise are for pixels of {photograph.mm_per_px:.4f} mm.",
    ]
    for section, keys in sections.items():
        lines += [f"{section}:", *(f"  {name}: {json_.dumps(value)}" for name, value in keys.items())]
    write_whole(out, "\n".join(lines) + "\n")
    if json:
        print(json_.dumps({"job": sections, "cortex_mm2": photograph.cortex_mm2, "out": str(out)}))
    else:
        print("\n".join([*lines, f"wrote {out}; draw it with: synth preview {out}"]))


def _refuse_to_replace(out: Path) -> None:
    if out.exists() or not out.resolve().parent.is_dir():
        raise UserError(f"{out}: {'exists already' if out.exists() else 'its folder does not exist'}")


@app.command(epilog="Example: synth new job.yaml")
def new(
    path: Annotated[Path, Argument(help="The job file to write.")] = Path("job.yaml"),
    series: Annotated[Path | None, Option("--from-series", help="For files as of mechanics.source.")] = None,
) -> None:
    """Writes a job file in which every key is explained, or one for another program's simulation."""
    from synth.job import job_writer

    text = job_writer.document_job()
    if series is not None:
        from synth.publish.series_job import as_job  # here, as it imports the finite elements

        text = as_job(series)
    with as_user_error(f"{path}: cannot be written"), path.open("x", encoding="utf-8") as file:
        file.write(text)
    print(f"wrote {path}; render it with: synth render {path} -o out")


@app.command(epilog="Example: synth schema > job.schema.json")
def schema() -> None:
    """Prints the JSON schema of job files, for editors."""
    from synth.job import job_writer

    print(json_.dumps(job_writer.schema(), indent=2))


@app.command(epilog="Example: synth preview demo --count 9 --out sheet.png")
def preview(
    job: Annotated[
        str,
        Argument(
            help="A job file, a named job (see `synth render`), or a brain (OBJ, STL, GIfTI, lh.pial...)."
        ),
    ],
    overrides: Overrides = None,
    out: Annotated[Path, Option("--out", "-o", help="The PNG to write.")] = Path("sheet.png"),
    count: Annotated[int, Option("--count", "-n", min=1, max=100, help="Scenarios to show.")] = 9,
    radius: Annotated[float, Option(min=3, max=60, help="Radius of a brain's craniotomy [mm].")] = 12.0,
    json: Json = False,
) -> None:
    """Draws a contact sheet of a job's scenarios and prints the disk that the whole job needs.

    For the surface of a brain: draws the best places for a craniotomy and prints them as lines of a job.
    """
    from synth.dataset.size_forecast import amount, estimate
    from synth.job import reader
    from synth.publish import contact_sheet, openings
    from synth.sequence.job_series import read_job_series
    from synth.system.checked_file import write_picture
    from synth.system.terminal import counting

    if out.suffix.lower() != ".png" or not out.parent.is_dir():
        raise UserError(f"{out}: cannot be written as PNG")
    if Path(job).is_file() and Path(job).suffix.lower() not in ("", ".yaml", ".yml", ".json"):
        fill_holes = reader.load_job("demo", overrides or []).anatomy.fill_holes
        candidates = openings.find_openings(Path(job), radius, count, fill_holes)
        write_picture(out, openings.draw_openings(Path(job), candidates, radius, fill_holes))
        places = [
            opening.craniotomy(radius).model_dump(include={"point", "direction"}) for opening in candidates
        ]
        lines = openings.as_job(Path(job), candidates, radius, fill_holes)
        text = f"# {out} shows these craniotomies, the best first\n{lines}"
        print(json_.dumps({"sheet": str(out), "openings": places}) if json else text)
        return
    loaded_job = reader.load_job(job, overrides or [])
    if loaded_job.mechanics.source is not None and not json:
        print(read_job_series(loaded_job, 0).summary)
    with counting("Compiling the first time, then drawing") as progress:
        picture = contact_sheet.draw_sheet(loaded_job, count, progress)
    write_picture(out, picture)
    disk_bytes = estimate(loaded_job) * loaded_job.sequences
    if json:
        print(json_.dumps({"sheet": str(out), "disk_bytes": disk_bytes}))
        return
    print(
        f"wrote {out}, each view at most {contact_sheet.TILE_PX} px wide\n"
        f"the whole job: {loaded_job.sequences} sequences of {loaded_job.frames} frames, "
        f"{amount(disk_bytes)} of disk; `synth status` gives its time once a sequence is done"
    )


def _read_series(job: Job) -> tuple[str, ...]:
    """Reads the first series of a job with `mechanics.source`, says what it is, and what is doubtful."""
    if job.mechanics.source is None:
        return ()
    from synth.sequence.job_series import forget, read_job_series

    series = read_job_series(job, 0)
    print(f"mechanics.source: {series.summary}", file=sys.stderr)
    _print_doubts({text: [0] for text in series.cautions})
    forget()
    return series.cautions


def _print_doubts(cautions: Mapping[str, Sequence[int]]) -> None:
    """Prints what is doubtful about another program's series, each with the sequences of which it is."""
    for text, sequences in cautions.items():
        extent = f" ({len(sequences)} sequences, first {sequences[0]:06d})"
        if len(sequences) == 1 and sequences[0] == 0:
            extent = ""
        print(f"warning: mechanics.source: {text}{extent}", file=sys.stderr)


@app.command(epilog="Example: synth render demo --out out render.spp=8 sequences=100")
def render(
    job: Source,
    overrides: Overrides = None,
    out: Annotated[Path, Option("--out", "-o", help="A folder; if unfinished, continued.")] = Path("out"),
    workers: Annotated[int | None, Option(min=1, help="Number of processes; default: one per core.")] = None,
    engine: Annotated[
        str, Option(help="local, dask://host:port, tls://host:port, or a SLURM cluster's YAML file.")
    ] = "local",
    gpus: Annotated[str, Option(help="GPUs shared by the workers: auto, none, or numbers as 0,1.")] = "auto",
    memory: Annotated[float | None, Option(help="Of each process [GB]; default: its share.")] = None,
    part: Annotated[
        str | None, Option(help="One of several runs into a folder, as 3/40 of an array.")
    ] = None,
    mix_versions: Annotated[bool, Option("--mix-versions", help="Continue another version's data.")] = False,
    retry: Annotated[bool, Option("--retry", help="Compute sequences again that failed before.")] = False,
    json: Json = False,
) -> None:
    """Renders the dataset of a job. Exit code 1 if some of its sequences failed."""
    from synth.dataset.dataset_folder import Folder, parse_part
    from synth.engine.journal import RunBars
    from synth.engine.run import Options, run_job
    from synth.job.reader import load_job

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends it as Ctrl-C does
    loaded_job = load_job(job, overrides or [])
    doubts = _read_series(loaded_job)
    run_part = None if part is None else parse_part(part)
    if retry:
        Folder(out, run_part).clear_failures()
    options = Options(engine, workers, gpus, memory, mix_versions=mix_versions, part=run_part)
    with RunBars() as bars:
        summary = run_job(loaded_job, out, options, bars)
    _print_doubts({text: sequences for text, sequences in summary.cautions.items() if text not in doubts})
    if json:
        print(json_.dumps({**vars(summary), "out": str(out)}))
    else:
        print(f"{summary.already + summary.done} of {summary.total} sequences in {out}")
        for index, reason in summary.failed.items():
            print(f"  {index:06d} failed: {reason}", file=sys.stderr)
        if summary.failed:
            print(f"  their logs are in {Folder(out).logs}", file=sys.stderr)
    card = loaded_job.card
    if not summary.already and card.authors == type(card)().authors:  # in the first run only
        licence = f"its licence is {card.licence}" if card.licence else "it has no licence"
        print(
            f"note: the card names no author, and {licence}: set card.authors and card.licence in the job "
            "and run the command again, which changes only the card",
            file=sys.stderr,
        )
    if summary.failed:
        raise typer.Exit(1)


@app.command(epilog="Example: synth status out")
def status(out: Out, json: Json = False) -> None:
    """Shows how many sequences are done, running and failed, and the time and disk still needed."""
    from dataclasses import asdict

    from synth.engine.status import lines, read_status

    progress = read_status(out)
    print(json_.dumps(asdict(progress)) if json else "\n".join(lines(progress)))


@app.command("split", epilog="Example: synth split out --by anatomy --hold-out calf")
def split_command(
    out: Out,
    by: Annotated[str, Option(help="anatomy, opening or sequence.")] = "anatomy",
    shares: Annotated[str, Option(help="Of train, validation and test.")] = "0.7,0.15,0.15",
    hold_out: Annotated[list[str] | None, Option(help="An appearance family for testing only.")] = None,
    share_anatomy: Annotated[bool, Option("--share-anatomy", help="Allow one brain on all sides.")] = False,
    json: Json = False,
) -> None:
    """Replaces the split of a dataset. No anatomy is on two sides, no held-out family in training."""
    from synth.dataset import index, sequence_split
    from synth.dataset.dataset_folder import Folder
    from synth.publish.card import write_card

    folder = Folder(out)
    radius_mm = folder.job().anatomy.craniotomy.radius_mm
    rule = sequence_split.parse_rule(
        by, shares, hold_out or [], share_anatomy, 2 * radius_mm * (by == "opening")
    )
    rows = index.write_index(folder, rule)
    write_card(folder)
    counts = sequence_split.count(rows)
    if rule.share_anatomy:
        print("warning: sides may share a brain: test scores don't hold for other brains", file=sys.stderr)
    print(json_.dumps(counts) if json else ", ".join(f"{side} {n}" for side, n in counts.items()))


@app.command(epilog="Example: synth report out")
def report(out: Out) -> None:
    """Writes a dataset's description, README.md, again; new sequences get a side of the split."""
    from synth.dataset.dataset_folder import Folder
    from synth.dataset.index import write_index
    from synth.publish.card import write_card

    folder = Folder(out)
    card = folder.job().card
    write_index(folder)
    print(write_card(folder))
    if missing := ", ".join(name for name in ("authors", "licence") if not getattr(card, name)):
        print(f"not in the job's card, so not in the description: {missing}", file=sys.stderr)


@app.command(epilog="Example: synth export out out-hf --to hf")
def export(
    out: Out,
    target: Annotated[Path, Argument(help="The new folder.")],
    to: Annotated[
        str,
        Option(help=f"{', '.join(EXPORTERS.names())}."),
    ] = "folder",
    overlay: Annotated[
        list[str] | None, Option(help="Of a video: flow, recovered, force, none. [default: flow and force]")
    ] = None,
    interval: Annotated[str | None, Option(help="Time range of a video: FIRST:LAST in seconds.")] = None,
) -> None:
    """Exports a dataset to the format of another library, or as videos."""
    from synth.publish.export.exporter_registry import export_dataset

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # which removes what is half-written
    options = {}
    if to == "video":
        overlays = overlay and [name for name in overlay if name != "none"]
        options = {"overlays": overlays, "interval_s": _interval(interval)}
    elif overlay or interval:
        raise UserError("--overlay and --interval need --to video")
    print(f"{export_dataset(out, target, to, **options)} sequences in {target}")


def _interval(text: str | None) -> tuple[float, float] | None:
    """The times of FIRST:LAST in seconds; either may be left out."""
    if text is None:
        return None
    first, colon, last = text.partition(":")
    with as_user_error(f"--interval {text}: is not FIRST:LAST in seconds"):
        start, end = float(first or "-inf"), float(last or "inf")
        if not colon or not start <= end:
            raise ValueError("FIRST is after LAST" if colon else "no colon")
    return start, end


@app.command(epilog="Example: synth verify out --fast")
def verify(
    out: Out,
    fast: Annotated[bool, Option("--fast", help="Only some frames and sequences, no checksums.")] = False,
    json: Json = False,
) -> None:
    """Checks the integrity and physical consistency of a dataset. Exit code 1 if a check fails."""
    from synth.checks.verify import verify_dataset

    report = verify_dataset(out, fast=fast)
    print(json_.dumps(report.as_dict()) if json else "\n".join(report.lines()))
    if not report.good:
        raise typer.Exit(1)


@app.command(epilog="Example: synth view out --sequence 1 -f 0 -f 5 --save picture.jpg")
def view(
    out: Out,
    sequence: Index = 0,
    save: Annotated[Path, Option(help="A picture, .png or .jpg, or all frames: .webp.")] = Path("view.png"),
    frame: Annotated[
        list[int] | None, Option("--frame", "-f", help="Repeatable; default: the largest force.")
    ] = None,
) -> None:
    """Draws frames of a sequence with their flow and force map side by side, as in the README."""
    from synth.dataset import location
    from synth.dataset.store import open_sequence
    from synth.publish.picture import draw_sequence, find_strongest, write_animation
    from synth.system.checked_file import write_picture

    is_animation = save.suffix.lower() == ".webp"
    if not is_animation and save.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise UserError(f"{save}: its name must end with .png, .jpg or .webp")
    shown_sequence = open_sequence(location.store(out, sequence))
    numbers = frame or ([*range(shown_sequence.frames)] if is_animation else [find_strongest(shown_sequence)])
    rows = draw_sequence(shown_sequence, numbers)
    save.parent.mkdir(parents=True, exist_ok=True)
    if is_animation:
        write_animation(save, rows, len(numbers), shown_sequence.attrs["fps"])
    else:
        write_picture(save, rows)
    print(f"wrote {save}")


@app.command(epilog="Example: synth doctor .")
def doctor(
    folder: Annotated[Path, Argument(help="Where datasets are to be written.")] = Path(), json: Json = False
) -> None:
    """Reports what this machine offers, what it lacks, and how to fix that."""
    from synth.system.doctor import diagnose, lines

    findings = diagnose(folder)
    print(json_.dumps([vars(finding) for finding in findings]) if json else "\n".join(lines(findings)))
