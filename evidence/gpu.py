"""Checks and timings of everything that an NVIDIA GPU changes, each step in a process of its own."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import typer

from evidence import report
from evidence.all import run_steps
from evidence.study import Study
from synth.errors import UserError
from synth.system import gpu


def measure(out: Path = Path("runs/gpu"), only: str = "") -> None:
    """Runs the steps, with a log of each in `out`. Exit code 1 if one fails.

    `only`: name of the only step to run.
    """
    if gpu.probe() is None:
        raise UserError("no NVIDIA GPU and driver were found; `synth doctor` lists what is missing")
    known = steps(out)
    if only and only not in known:
        raise UserError(f"--only {only}: the steps are {', '.join(known)}")
    rows = run_steps([(name, known[name]) for name in ([only] if only else known)], out)
    typer.echo(report.markdown(rows))
    raise typer.Exit(int(any(row["exit_code"] for row in rows)))


def steps(out: Path) -> Mapping[str, Sequence[str]]:
    """Steps in order: first correctness, then speed."""
    data, model, cuda = str(out / "data"), str(out / "model"), "cuda"
    found = {
        "doctor": ("synth", "doctor"),
        "variants agree": ("pytest", "-q", "tests/synth/render/test_scene.py"),
        "networks": ("evidence", "learn.pareto", "--device", cuda, "--out", str(out / "learn")),
        "dataset": ("synth", "render", "demo", "-o", data, "render.variant=cuda_ad_rgb"),
        "verify": ("synth", "verify", data),
        "training": ("learn", "train", data, "-o", model, "--accelerator", cuda, "--input", "mixed"),
    }
    return {name: ("-m", *words) for name, words in found.items()}


STUDY = Study(measure, steps=())
