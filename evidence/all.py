"""All stored results, made again; the studies share datasets.

Run: make evidence PHOTO=CORTEX.jpg MECHANICS_PYTHON=A/bin/python PICTURES_PYTHON=B/bin/python

An interrupted run goes on with --moved, which leaves out results that stand. The pretrained networks are
files of the checkout and are not trained here.
"""

import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatch
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import typer

from evidence import report, result_status, study

Step = tuple[str, Sequence[str]]
"""Its name, and the arguments after `python`."""

_SMALL = ("render.size=[256, 192]",)
DATASETS: Mapping[str, tuple[str, ...]] = {
    "mission": ("mission", "sequences=375"),  # as many as the stored gap is of
    "mission-ood": (str(report.CHECKOUT / "evidence/curves/mission-ood.yaml"), "sequences=80"),
    "gap-clinical": ("clinical", "sequences=40", "frames=8", "fps=2.5", "render.stereo_mm=24", *_SMALL),
    "pulsating": (
        "mission",
        "seed=774",
        "sequences=16",
        "frames=40",
        "fps=1.5",
        "fem.pulse={heart_mm: [0.1, 0.5], breath_mm: [0.1, 1.0]}",
        "fem.membrane.probability=0.4",
        "fem.travel_mm=[0.4, 6]",
        "fem.instruments=[1, 1]",
    ),
    "paper": (
        "paper",
        "sequences=90",
        "frames=20",
        "fps=11.1",
        "anatomy.vertices=12000",
        *_SMALL,
        "flow.backend=ideal",
    ),
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
    moved: Annotated[bool, typer.Option(help="Only results that no longer stand.")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Studies at a time; those that hold times run alone.")] = 1,
) -> None:
    """Makes all stored results again. Exit code 1 if a step fails; its log is WORK/logs/STEP.log."""
    options = {"photo": photo, "mechanics_python": mechanics_python, "pictures_python": pictures_python}
    steps, left_out = plan(
        work,
        {name: path for name, path in options.items() if path is not None},
        only,
        find_standing() if moved else set(),
    )
    for line in left_out:
        typer.echo(line, err=True)
    # With several threads on small matrices, waiting costs the physics twenty times its CPU time.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    rows = run_steps(steps, work / "logs", jobs)
    typer.echo(f"{report.markdown(rows)}\n{sum(row['cpu_s'] for row in rows) / 3600:.1f} CPU-hours")
    # A dataset may lack a scene whose load exceeded the law's range; steps that need it fail themselves.
    raise typer.Exit(int(any(row["exit_code"] for row in rows if row["name"] not in DATASETS)))


def find_standing() -> set[str]:
    """Names of the studies all of whose results stand."""
    state = {str(status.file.relative_to(report.RESULTS)): status.stands for status in result_status.gather()}
    results = {name: study.load(name).result for name in study.names()}
    files = {name: [file for file in state if fnmatch(file, result)] for name, result in results.items()}
    return {name for name, matches in files.items() if matches and all(state[file] for file in matches)}


def run_steps(steps: Sequence[Step], logs: Path, jobs: int = 1) -> list[dict[str, Any]]:
    """Runs steps, each in a process of its own; one that fails does not stop the next.

    Datasets are rendered first, one after the other; then `jobs` studies at a time, the steps of each in
    their order; then, alone, those that hold times. `logs`: folder of NAME.log. Returns `name`, `exit_code`,
    `wall_s` and `cpu_s` of each.
    """
    logs.mkdir(parents=True, exist_ok=True)
    studies = study.names()

    def run(part: Sequence[Step]) -> list[dict[str, Any]]:
        return [run_step(step, logs) for step in part]

    def owner(step: Step) -> str:
        name = step[0].split(" ")[0]
        return name if name in studies else ""

    rows = run([step for step in steps if not owner(step)])
    by_study: dict[str, list[Step]] = {}
    for step in steps:
        if owner(step):
            by_study.setdefault(owner(step), []).append(step)
    timed = {name for name in by_study if study.load(name).timed}
    with ThreadPoolExecutor(jobs) as pool:
        rows += chain(*pool.map(run, [part for name, part in by_study.items() if name not in timed]))
    return rows + run([step for name in sorted(timed) for step in by_study[name]])


def run_step(step: Step, logs: Path) -> dict[str, Any]:
    """Runs a step; see `run_steps`."""
    name, arguments = step
    begin = time.perf_counter()
    with (logs / f"{name.replace(' ', '-')}.log").open("wb") as log:
        process = subprocess.Popen([sys.executable, *arguments], stdout=log, stderr=log)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    wall_s, cpu_s = time.perf_counter() - begin, usage.ru_utime + usage.ru_stime
    typer.echo(f"{name}: exit code {process.returncode}, {wall_s:.0f} s, {cpu_s:.0f} of the CPU", err=True)
    times = {"wall_s": round(wall_s, 1), "cpu_s": round(cpu_s, 1)}
    return {"name": name, "exit_code": process.returncode} | times


def plan(
    work: Path, inputs: Mapping[str, Path], only: str = "", excluded: Sequence[str] | set[str] = ()
) -> tuple[list[Step], list[str]]:
    """Steps of the studies whose name contains `only`, after those that render their datasets.

    `inputs`: files by the name of their option; `excluded`: studies that are left out. Returns also a message
    for each step that lacks a file.
    """
    placeholders = {"work": work, **inputs, **{name: work / name for name in DATASETS}}
    steps: list[Step] = []
    left_out, used_names = [], set[str]()
    for name in study.names():
        lines = study.load(name).steps if only in name and name not in excluded else ()
        for k, line in enumerate(lines, 1):
            words = set(re.findall(r"\{([\w-]+)\}", line))
            if missing := sorted(words - set(placeholders)):
                left_out.append(f"{name} is left out: no --{', --'.join(missing).replace('_', '-')}")
                continue
            used_names |= words
            arguments = [word.format_map(placeholders) for word in shlex.split(line)]
            steps.append((name if len(lines) == 1 else f"{name} {k}", ("-m", "evidence", name, *arguments)))
    render_steps: list[Step] = [
        (name, ("-m", "synth", "render", job, "-o", str(work / name), *changes))
        for name, (job, *changes) in DATASETS.items()
        if name in used_names
    ]
    return [*render_steps, *steps], left_out
