"""All stored results, made again at one commit; the studies share datasets.

Run: make evidence PHOTO=CORTEX.jpg MECHANICS_PYTHON=A/bin/python PICTURES_PYTHON=B/bin/python

Steps that have passed at this commit are skipped. The pretrained networks are files of the commit and are not
trained here.
"""

import os
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from evidence import report, study
from evidence.steps import Step, run_steps

DATASETS: Mapping[str, tuple[str, ...]] = {
    "mission": ("mission", "sequences=240"),
    "mission-ood": (str(report.CHECKOUT / "evidence/curves/mission-ood.yaml"), "sequences=80"),
    "stereo-640": ("stereo", "sequences=8", "seed=77", "render.size=[640, 480]"),
    "stereo-320": ("stereo", "sequences=8", "seed=77", "render.size=[320, 240]"),
}
"""Datasets of studies' steps: job and changes of its keys."""


def main(
    work: Annotated[Path, typer.Argument(help="Folder for data and logs; a later run continues from it.")],
    photo: Annotated[Path | None, typer.Option(help="A photograph of exposed cortex.")] = None,
    mechanics_python: Annotated[Path | None, typer.Option(help="A Python with felupe, pypardiso.")] = None,
    pictures_python: Annotated[Path | None, typer.Option(help="A Python with bpy.")] = None,
    only: Annotated[str, typer.Option(help="Only studies whose name contains this.")] = "",
) -> None:
    """Makes all stored results again. Exit code 1 if a step fails; its log is WORK/COMMIT/logs/STEP.log."""
    work = work / (report.commit() or "unknown")
    options = {"photo": photo, "mechanics_python": mechanics_python, "pictures_python": pictures_python}
    steps, left_out = plan(work, {name: path for name, path in options.items() if path is not None}, only)
    for line in left_out:
        typer.echo(line, err=True)
    # With several threads on small matrices, waiting costs the physics twenty times its CPU time.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    rows = run_steps(steps, work / "steps.json", work / "logs")
    typer.echo(f"{report.markdown(rows)}\n{sum(row['cpu_s'] for row in rows) / 3600:.1f} CPU-hours")
    # A dataset may lack a scene whose load exceeded the law's range; steps that need it fail themselves.
    raise typer.Exit(int(any(row["exit_code"] for row in rows if row["name"] not in DATASETS)))


def plan(work: Path, given: Mapping[str, Path], only: str = "") -> tuple[list[Step], list[str]]:
    """Steps of the studies whose name contains `only`, after those that render their datasets.

    `given`: files by the name of their option. Returns also a message for each step that lacks one.
    """
    known = {"work": work, **given, **{name: work / name for name in DATASETS}}
    steps: list[Step] = []
    left_out, needed = [], set[str]()
    for name in study.names():
        lines = study.load(name).steps if only in name else ()
        for k, line in enumerate(lines, 1):
            words = set(re.findall(r"\{([\w-]+)\}", line))
            if missing := sorted(words - set(known)):
                left_out.append(f"{name} is left out: no --{', --'.join(missing).replace('_', '-')}")
                continue
            needed |= words
            arguments = [word.format_map(known) for word in shlex.split(line)]
            steps.append((name if len(lines) == 1 else f"{name} {k}", ("-m", "evidence", name, *arguments)))
    rendered: list[Step] = [
        (name, ("-m", "synth", "render", job, "-o", str(work / name), *changes))
        for name, (job, *changes) in DATASETS.items()
        if name in needed
    ]
    return [*rendered, *steps], left_out
