"""All stored results, made again at one commit, in an order that shares datasets.

Run: make evidence PHOTO=CORTEX.jpg MECHANICS_PYTHON=A/bin/python PICTURES_PYTHON=B/bin/python

Steps that have passed at this commit are skipped. Without a photograph, or without the two other Python
environments, the steps that need them are left out with a message. The pretrained networks are files of the
commit and are not trained here.
"""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Annotated

import typer

from evidence import report
from evidence.foreign.recordings import KINDS
from evidence.steps import Step, run_steps

_CURVES = report.CHECKOUT / "evidence/curves"
_FOREIGN, _EXVIVO = 3, 6  # recordings of each kind; recordings in all
_CAMERAS = {"monocular": ("1", "mono"), "stereo": ("2", "stereo")}  # how many, and the pretrained model


def main(
    work: Annotated[Path, typer.Argument(help="Folder for data and logs; a later run continues from it.")],
    photo: Annotated[Path | None, typer.Option(help="A photograph of exposed cortex.")] = None,
    mechanics_python: Annotated[Path | None, typer.Option(help="A Python with felupe, pypardiso.")] = None,
    pictures_python: Annotated[Path | None, typer.Option(help="A Python with bpy.")] = None,
    only: Annotated[str, typer.Option(help="Only steps whose name contains this.")] = "",
) -> None:
    """Makes all stored results again. Exit code 1 if a step fails; its log is WORK/COMMIT/logs/STEP.log."""
    work = work / (report.commit() or "unknown")
    data = shared(work)
    steps = [*data, *standalone(work)]
    if photo is None:
        typer.echo("no --photo: realism, appearance and ex vivo stand-ins are left out", err=True)
    else:
        steps += [*photograph(photo), *exvivo(work, photo)]
    if mechanics_python is None or pictures_python is None:
        typer.echo("no --mechanics-python and --pictures-python: foreign recordings are left out", err=True)
    else:
        steps += foreign(work, mechanics_python, pictures_python)
    # Last: its images lie outside docs/results, so that later steps would be of a modified checkout.
    steps.append(_script("render.gallery"))
    chosen = [step for step in steps if only in step[0]]
    # With several threads on small matrices, waiting costs the physics twenty times its CPU time.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    rows = run_steps(chosen, work / "steps.json", work / "logs")
    report.show({"steps": rows, "CPU-hours": sum(row["cpu_s"] for row in rows) / 3600})
    # A dataset may lack a scene whose load exceeded the law's range; steps that need it fail themselves.
    made = {name for name, _ in data}
    raise typer.Exit(int(any(row["exit_code"] for row in rows if row["name"] not in made)))


def shared(work: Path) -> list[Step]:
    """Steps that render the datasets of several experiments."""
    return [
        _render("mission", "mission", work, sequences=400),
        _render("mission-ood", _CURVES / "mission-ood.yaml", work, sequences=80),
        _render("stereo-640", "stereo", work, sequences=8, seed=77, **{"render.size": "[640, 480]"}),
        _render("stereo-320", "stereo", work, sequences=8, seed=77, **{"render.size": "[320, 240]"}),
    ]


def standalone(work: Path) -> list[Step]:
    """Steps that need neither a photograph nor another Python."""
    mission, ood = str(work / "mission"), str(work / "mission-ood")
    labels, clips = str(work / "labels"), str(work / "clips")
    networks = [word for name in ("mono", "stereo") for word in ("--model", f"{name}=learn/models/{name}")]
    return [
        _script("fem.half_space", "--tets", "1600,5000"),
        _script("fem.pareto", "--refined", "8000", "--contacts", "2"),
        _script("fem.relief", "--scenes", "40", "--tets", "1600,5000,20000"),
        _script("render.pareto", "--width", "640,256"),
        _script("render.stability"),
        _script("flow.experiment"),
        _script("flow.pareto", "--count", "4"),
        _script("flow.foreign", "--jobs", "1"),
        _script("flow.stability", "--count", "1", "--size", "224"),
        _script("flow.stereo", str(work / "stereo-640"), str(work / "stereo-320")),
        _script("engine.speed"),
        _script("learn.shipped", mission, *networks, "--unseen", ood, "--cache", clips),
        _script("learn.runs", labels),
        _script("learn.pareto", "--cache", labels, "--repeats", "60", "--seeds", "1"),
        _script("learn.stability", labels),
        _script(
            *("curves.experiment", mission, "--unseen", ood, "--models", "ridge,d2fnet-s"),
            *("--sizes", "30,100,300", "--test", "56", "--select", "40", "--work", str(work / "curves")),
        ),
        _script(
            *("gap.experiment", mission, "--unseen", ood, "--fit", "300", "--epochs", "24"),
            *("--seeds", "1", "--flow", "tvl1", "--work", str(work / "gap")),
        ),
        _script("scoring.fusion", ood, "--work", str(work / "fusion")),
        _script("scoring.pulse", "--seconds", "20", "--count", "2", "--size", "160"),
        _script("scoring.cost", "learn/models/mono"),
        _script("scoring.stability", str(work / "degraded")),
        _script("mechanics.experiment", "--fit", "35", "--test", "12", "--work", str(work / "mechanics")),
        _script("end_to_end.pareto", "--fit", "40", "--test", "24", "--work", str(work / "end-to-end")),
        _script("tune.experiment"),
    ]


def photograph(photo: Path) -> list[Step]:
    """Steps that compare rendered frames with a photograph, by default and with a fitted camera."""
    return [
        _script("render.realism", str(photo), "--frames", "12", "--family", "healthy"),
        _script("appearance.classifier", str(photo), "--frames", "5", "--epochs", "8"),
    ]


def exvivo(work: Path, photo: Path) -> list[Step]:
    """Steps that render and score ex vivo stand-ins of 30 s, monocular and in stereo."""
    steps: list[Step] = []
    for name, (cameras, model) in _CAMERAS.items():
        made = work / f"exvivo-{name}"
        about = ("--count", str(_EXVIVO), "--seconds", "30", "--fps", "10", "--cameras", cameras)
        _, words = _script("scoring.exvivo", "--out", str(made), *about, "--photo", str(photo))
        rendering = f"exvivo {name}", words
        folders = [made / f"{k:03d}" for k in range(_EXVIVO)]
        scoring = _scored(f"exvivo {name}", rendering, folders, model, report.RESULTS / "exvivo" / name)
        steps += [rendering, *scoring]
    return steps


def foreign(work: Path, mechanics: Path, pictures: Path) -> list[Step]:
    """Steps that make and score recordings by other mechanics and another renderer."""
    made, left = work / "foreign", work / "foreign-left"
    pythons = ("--mechanics-python", str(mechanics), "--pictures-python", str(pictures))
    making = _script("foreign.recordings", str(made), "--count", str(_FOREIGN), *pythons, "--left", str(left))
    steps = [making]
    names = [f"{kind}-{k}" for kind in KINDS for k in range(_FOREIGN)]
    for name, folder in (("stereo", made), ("monocular", left)):
        out, folders = report.RESULTS / "learn/foreign" / name, [folder / one for one in names]
        steps += _scored(f"foreign {name}", making, folders, _CAMERAS[name][1], out)
    return steps


def _scored(name: str, making: Step, recordings: list[Path], model: str, out: Path) -> list[Step]:
    """`bench score` of each recording that the step `making` makes, and `bench pool` of all."""
    scores = [folder.with_name(f"{folder.name}-score") for folder in recordings]
    steps: list[Step] = [
        (f"{name} {folder.name}", ("-m", "bench", "score", str(folder), "--model", model, "-o", str(score)))
        for folder, score in zip(recordings, scores, strict=True)
    ]
    made = ["python", *(Path(word).name for word in making[1])]
    by = f"{shlex.join(made)}\n    bench score RECORDING --model {model}\n    bench pool SCORES"
    pooled = ("-m", "bench", "pool", *map(str, scores), "-o", str(out), "--by", by)
    return [*steps, (f"{name} pooled", pooled)]


def _render(name: str, job: str | Path, work: Path, **changes: object) -> Step:
    words = (f"{key}={value}" for key, value in changes.items())
    return name, ("-m", "synth", "render", str(job), "-o", str(work / name), *words)


def _script(module: str, *words: str) -> Step:
    return module, ("-m", f"evidence.{module}", *words)


if __name__ == "__main__":
    typer.run(main)
