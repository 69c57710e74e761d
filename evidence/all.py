"""Kept results anew, of one commit, in an order that shares data.

Run: make evidence PHOTO=CORTEX.jpg MECHANICS_PYTHON=A/bin/python PICTURES_PYTHON=B/bin/python

What has passed at this commit is not run again. Without a photograph, or the two other Pythons, what needs
them is left out and named. Weights that come along are not trained here: they are files of the commit.
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
_FOREIGN, _EXVIVO = 3, 6
"""Recordings of each kind; recordings."""


def main(
    work: Annotated[Path, typer.Argument(help="Folder for data and logs, to go on from.")],
    photo: Annotated[Path | None, typer.Option(help="A photograph of exposed cortex.")] = None,
    mechanics_python: Annotated[Path | None, typer.Option(help="A Python with felupe, pypardiso.")] = None,
    pictures_python: Annotated[Path | None, typer.Option(help="A Python with bpy.")] = None,
    only: Annotated[str, typer.Option(help="Steps whose name has this.")] = "",
) -> None:
    """Makes kept results anew. Exit code 1 if a step fails; its log is WORK/COMMIT/logs/STEP.log."""
    work = work / (report.commit() or "unknown")
    data = shared(work)
    steps = [*data, *rooms(work)]
    if photo is None:
        typer.echo("no --photo: the look and pseudo ex vivo recordings are left out", err=True)
    else:
        steps += [*look(photo), *exvivo(work, photo)]
    if mechanics_python is None or pictures_python is None:
        typer.echo("no --mechanics-python and --pictures-python: foreign recordings are left out", err=True)
    else:
        steps += foreign(work, mechanics_python, pictures_python)
    # Last: its pictures lie outside of docs/results, and what comes after them were of a changed checkout.
    steps.append(_script("render.gallery"))
    chosen = [step for step in steps if only in step[0]]
    # Threads that wait for one another on small matrices cost physics twenty times its CPU.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    rows = run_steps(chosen, work / "steps.json", work / "logs")
    report.show({"steps": rows, "CPU-hours": sum(row["cpu_s"] for row in rows) / 3600})
    # A dataset may lack a scene whose load was too much; one that lacks many fails what reads it.
    made = {name for name, _ in data}
    raise typer.Exit(int(any(row["exit_code"] for row in rows if row["name"] not in made)))


def shared(work: Path) -> list[Step]:
    """Datasets that several experiments read."""
    return [
        _render("mission", "mission", work, sequences=400),
        _render("mission-ood", _CURVES / "mission-ood.yaml", work, sequences=80),
        _render("stereo-640", "stereo", work, sequences=8, seed=77, **{"render.size": "[640, 480]"}),
        _render("stereo-320", "stereo", work, sequences=8, seed=77, **{"render.size": "[320, 240]"}),
    ]


def rooms(work: Path) -> list[Step]:
    """What needs neither a photograph nor another Python."""
    mission, unseen = str(work / "mission"), str(work / "mission-ood")
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
        _script("learn.shipped", mission, *networks, "--unseen", unseen, "--cache", clips),
        _script("learn.runs", labels),
        _script("learn.pareto", "--cache", labels, "--repeats", "60", "--seeds", "1"),
        _script("learn.stability", labels),
        _script(
            *("curves.experiment", mission, "--unseen", unseen, "--models", "ridge,d2fnet-s"),
            *("--sizes", "30,100,300", "--asked", "56", "--choosing", "40", "--work", str(work / "curves")),
        ),
        _script(
            *("gap.experiment", mission, "--unseen", unseen, "--fit", "300", "--epochs", "24"),
            *("--seeds", "1", "--flow", "tvl1", "--work", str(work / "gap")),
        ),
        _script("scoring.fusion", unseen, "--work", str(work / "together")),
        _script("scoring.pulse", "--seconds", "20", "--count", "2", "--size", "160"),
        _script("scoring.cost", "learn/models/mono"),
        _script("scoring.stability", str(work / "films")),
        _script("mechanics.experiment", "--fit", "35", "--test", "12", "--work", str(work / "mechanics")),
        _script("end_to_end.pareto", "--fit", "40", "--test", "24", "--work", str(work / "end-to-end")),
        _script("tune.experiment"),
    ]


def look(photo: Path) -> list[Step]:
    """The look beside a photograph, as it comes and fitted."""
    return [
        _script("render.realism", str(photo), "--frames", "12", "--family", "healthy"),
        _script("appearance.classifier", str(photo), "--frames", "5", "--epochs", "8"),
    ]


def exvivo(work: Path, photo: Path) -> list[Step]:
    """Pseudo ex vivo recordings of 30 s that differ from the training data in every family, scored."""
    steps: list[Step] = []
    for number, eyes, model in ((1, "monocular", "mono"), (2, "stereo", "stereo")):
        made = work / f"exvivo-{eyes}"
        about = ("--count", str(_EXVIVO), "--seconds", "30", "--fps", "10", "--eyes", str(number))
        _, words = _script("scoring.exvivo", "--out", str(made), *about, "--photo", str(photo))
        films = f"exvivo {eyes}", words
        folders = [made / f"{k:03d}" for k in range(_EXVIVO)]
        steps += [films, *_scored(f"exvivo {eyes}", films, folders, model, report.RESULTS / "exvivo" / eyes)]
    return steps


def foreign(work: Path, mechanics: Path, pictures: Path) -> list[Step]:
    """Recordings by another mechanics code and another renderer, scored by two eyes and by the left one."""
    made, left = work / "foreign", work / "foreign-left"
    pythons = ("--mechanics-python", str(mechanics), "--pictures-python", str(pictures))
    films = _script("foreign.recordings", str(made), "--count", str(_FOREIGN), *pythons, "--left", str(left))
    steps = [films]
    names = [f"{kind}-{k}" for kind in KINDS for k in range(_FOREIGN)]
    for eyes, folder, model in (("stereo", made, "stereo"), ("monocular", left, "mono")):
        out = report.RESULTS / "learn/foreign" / eyes
        steps += _scored(f"foreign {eyes}", films, [folder / name for name in names], model, out)
    return steps


def _scored(name: str, films: Step, recordings: list[Path], model: str, out: Path) -> list[Step]:
    """`bench score` of each recording that the step `films` makes, and `bench pool` of all."""
    scores = [folder.with_name(f"{folder.name}-score") for folder in recordings]
    steps: list[Step] = [
        (f"{name} {folder.name}", ("-m", "bench", "score", str(folder), "--model", model, "-o", str(score)))
        for folder, score in zip(recordings, scores, strict=True)
    ]
    made = ["python", *(Path(word).name for word in films[1])]
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
